//! dimos runs robot arms.

pub mod arm;
pub mod clock;
pub mod hardware;
pub mod joint;
pub mod telemetry;
pub mod testing;
pub mod yaml;
