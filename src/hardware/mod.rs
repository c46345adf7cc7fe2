//! Everything that talks to an arm: the adapter protocol, the table of adapters, the arms, one device thread each.

pub mod adapter;
pub mod adapter_util;
pub mod arms;
pub mod check;
pub mod conformance;
pub mod device;
pub mod registry;
pub mod sim;
pub mod transport;
