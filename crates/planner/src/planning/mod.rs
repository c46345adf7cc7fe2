//! From a start and a goal to a motion. Pure computation: no thread outside `request::planner_thread`, no clock but the
//! given deadline; the same seed gives the same path.
//!
//! ```text
//!  scene: robots and obstacles ─────┐
//!  request: a goal ─▶ ik ─▶ search: straight line │ RRT-Connect ─▶ shortcut ─▶ path
//!                                                                               │
//!  request: trajectory ◀─ verify ◀─ timing: constant_corner_speed │ blend, topp ◀┤
//!                                 └ curve: clock ◀─ line │ arc │ recorded path ◀──┘
//! ```

pub mod curve;
pub mod ik;
pub mod request;
pub mod scene;
pub mod search;
pub mod settings;
pub mod timing;

#[cfg(test)]
mod tests;
#[cfg(test)]
mod turning_tests;
