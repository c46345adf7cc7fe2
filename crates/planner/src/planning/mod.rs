//! From a start and a goal to a motion: search, shortcutting, time parameterization. Pure computation: no threads
//! outside `planner_thread`, no clock besides the given deadline; the same seed gives the same path.
//!
//! ```text
//!  pose ─▶ ik ─▶ goals ─▶ path_planner: straight line │ portfolio ─▶ shortcut ─▶ path
//!                                                                                 │
//!         JointTrajectory ◀─ verify ◀─ timing: constant_corner_speed │ blend, topp ◀─┘
//! ```

pub mod ahead;
pub mod blend;
mod candidates;
pub mod cartesian;
pub mod config;
mod constant_corner_speed;
mod double_s;
pub mod edges;
pub mod enclosure;
mod goals;
pub mod ignored_pairs;
pub mod ik;
mod jerk_limit;
pub mod joint_path;
mod legs;
pub mod level;
pub mod nearest;
pub mod padded;
pub mod path;
pub mod path_planner;
pub mod pipeline;
pub mod planner_thread;
pub mod planning_scene;
pub mod portfolio;
pub mod reach;
pub mod refine;
pub mod revalidate;
pub mod rrt_connect;
mod sampled;
pub mod sampler;
pub mod shortcut;
mod stage_cache;
pub mod start_contact;
pub mod thin;
pub mod timing;
pub mod tool_timing;
pub mod topp;
pub mod unplanned_joints;
pub mod verify;

#[cfg(test)]
mod request_tests;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod turning_tests;
