//! Ways to reach a device, shared by the arms.

pub mod can;
pub mod device_time;
pub mod tcp;
