//! A request from its goals to a verified trajectory, and the thread that plans.

pub mod ahead;
mod curve_timing;
pub(in crate::planning) mod goals;
pub mod joint_path;
pub(in crate::planning) mod legs;
pub mod pipeline;
pub mod planner_thread;
pub mod revalidate;
pub mod settings;
pub mod start_contact;
mod waypoint_times;

#[cfg(test)]
mod curve_tests;
#[cfg(test)]
mod request_tests;
