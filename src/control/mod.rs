//! The coordinator: one pure `tick` that turns states and requests into commands, and the thread that runs it.
//!
//! ```text
//! states ─▶ read ─▶ failsafe ─▶ requests ─▶ compute (tasks) ─▶ arbitrate ─▶ limit ─▶ route ─▶ commands
//! ```

pub mod arbitrate;
pub mod arm_control;
pub mod coast;
pub mod config;
pub mod conformance;
pub mod coordinator;
pub mod estimate;
pub mod failsafe;
pub mod feedback;
pub mod guard;
pub mod interruptions;
pub mod limit;
pub mod pace;
pub mod path_clock;
pub mod plausibility;
pub mod point_to_point;
pub mod rate;
pub mod request;
pub mod setpoints;
pub mod speed_override;
pub mod stalls;
pub mod task;
pub mod task_body;
pub mod task_config;
pub mod task_leader;
pub mod task_robot;
pub mod task_spec;
pub mod tasks;
pub mod tick_loop;
pub mod tracking;
pub mod written;
