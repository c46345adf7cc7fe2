//! dimos runs robot arms.

/// Version of this program, with the commit it was built from where that is known.
pub const VERSION: &str = env!("DIMOS_VERSION");

pub mod arm;
pub mod cli;
pub mod clock;
pub mod hardware;
pub mod joint;
pub mod rpc;
pub mod telemetry;
pub mod yaml;
