//! dimos runs robot arms.

pub mod arm;
pub mod blueprint;
pub mod clock;
pub mod hardware;
pub mod joint;
pub mod telemetry;
pub mod yaml;
