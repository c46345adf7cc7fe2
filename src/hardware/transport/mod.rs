//! Ways to reach a device, shared by the arms.

pub mod tcp;
