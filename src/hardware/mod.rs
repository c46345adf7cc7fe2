//! Everything that talks to arms: the adapter trait, the adapter registry, the arms, and one device thread per arm.

pub mod adapter;
pub mod adapter_util;
pub mod arms;
pub mod check;
pub mod conformance;
pub mod device;
pub mod registry;
pub mod service;
pub mod sim;
pub mod transport;
pub mod wire;
