//! What the run says of itself: reports, the log and its scene.

pub(in crate::runtime) mod log_file;
pub(in crate::runtime) mod log_throttle;
pub(in crate::runtime) mod logged_scene;
pub(in crate::runtime) mod metrics;
pub(in crate::runtime) mod reports;
