//! The bridge of a run to ROS 2 over rmw_zenoh: a node `dimos` that publishes what the run has, and, where it may
//! command, the action `FollowJointTrajectory` of each trajectory task.
//!
//! ```text
//!  /joint_states, /tf, /robot_description, /diagnostics ◀═ publish ◀─ run
//!  /TASK/follow_joint_trajectory: goal ═▶ action ─▶ follow: execute, watch, cancel ─▶ run
//!                  feedback, result ◀═══════╛
//!  /dimos/stop, /dimos/cancel, lists of controllers ═▶ services ─▶ run
//! ```
//!
//! The node joins the router of ROS as a client, and is one more client of the run's socket: for each goal one
//! connection, whose lease it is. [`names`] and [`types`] have its keys, [`attachment`] what comes with each message.

mod action;
mod attachment;
mod bridge;
mod follow;
mod goal;
mod names;
mod node;
mod publish;
mod services;
mod types;

pub(super) use bridge::{Bridge, report};
