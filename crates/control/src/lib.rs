//! Owns the pure tick: tasks, arbitration, limits, guard, what is believed of readings, gaps and rest. Never does I/O,
//! allocates, locks or logs on its path; never plans. Used by the run, and by the replay of logs.
//!
//! The coordinator: one pure `tick` that turns states and requests into commands, and the thread that runs it.
//!
//! ```text
//! states ─▶ read ─▶ failsafe ─▶ requests ─▶ compute (tasks) ─▶ arbitrate ─▶ limit ─▶ route ─▶ commands
//! ```

#![cfg_attr(
    not(test),
    deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::unreachable, clippy::indexing_slicing)
)]
#![forbid(unsafe_code)]
#![allow(rustdoc::broken_intra_doc_links, reason = "units are in brackets: [rad]")]

pub mod arbitrate;
pub mod arm_control;
pub mod belief;
pub mod config;
pub mod conformance;
pub mod coordinator;
pub mod failsafe;
pub mod guard;
pub mod interruptions;
pub mod limit;
pub mod pace;
pub mod path_clock;
pub mod point_to_point;
pub mod rate;
pub mod request;
pub mod rest;
pub mod speed_override;
pub mod task;
pub mod task_body;
pub mod task_config;
pub mod task_leader;
pub mod task_robot;
pub mod task_spec;
pub mod tasks;
pub mod tick_loop;
pub mod tool_limit;
