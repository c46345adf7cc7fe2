//! From a start and a goal to a motion: search, shortening, timing. Pure computation: no thread, no clock besides the
//! deadline it is given, the same seed gives the same path.
//!
//! ```text
//!  pose ─▶ ik ─▶ goals ─▶ planner: straight line │ rrt_connect ─▶ shortcut ─▶ path
//!                                                                             │
//!                                 JointTrajectory ◀─ verify ◀─ timing (topp) ◀─ blend ◀─┘
//! ```

pub mod ahead;
pub mod blend;
pub mod cartesian;
pub mod config;
pub mod desk;
mod goals;
pub mod idle;
pub mod ik;
pub mod leaving;
pub mod nearest;
pub mod padded;
pub mod path;
pub mod planner;
pub mod review;
pub mod rrt_connect;
pub mod sampler;
pub mod setup;
pub mod shortcut;
mod smooth;
pub mod solve;
mod steady;
pub mod timing;
pub mod topp;
pub mod verify;

#[cfg(test)]
mod tests;
#[cfg(test)]
mod turning_tests;
