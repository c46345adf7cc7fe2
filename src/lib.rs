//! dimos runs robot arms.

pub mod arm;
pub mod cli;
pub mod clock;
pub mod hardware;
pub mod joint;
pub mod recording;
pub mod telemetry;
pub mod yaml;
