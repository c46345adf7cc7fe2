//! dimos runs robot arms.

pub mod arm;
pub mod clock;
pub mod hardware;
pub mod joint;
pub mod rpc;
pub mod telemetry;
pub mod yaml;
