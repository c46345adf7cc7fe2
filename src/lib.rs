//! dimos runs robot arms.

pub mod arm;
pub mod clock;
pub mod control;
pub mod hardware;
pub mod joint;
pub mod rt;
pub mod telemetry;
pub mod trajectory;
pub mod yaml;
