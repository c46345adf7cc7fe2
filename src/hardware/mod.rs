//! Everything that talks to an arm: the adapter protocol, the table of adapters, the arms, one device thread each.

pub mod arms;
pub mod conformance;
pub mod device;
pub mod fit;
pub mod kit;
pub mod registry;
pub mod sim;
pub mod spec;
pub mod transport;
