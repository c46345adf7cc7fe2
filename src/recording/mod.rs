//! What happened, kept: a run's log is an MCAP file that ROS 2 tools, Foxglove, PlotJuggler and rerun open.
//!
//! ```text
//! tick ──ring──▶ recorder (thread) ─▶ tick_log (samples → messages) ─▶ log_writer (MCAP) ─▶ file
//! rpc ──notes──┘        └─▶ notices: events in words, for rpc and the terminal       replay ◀─┘
//! ```
//!
//! What is in a log, and what a reader may rely on: `docs/log-format.md`.

mod arm_messages;
pub mod cdr;
mod entries;
mod executes;
pub mod files;
pub mod log_writer;
pub mod messages;
pub mod notes;
pub mod recorder;
pub mod records;
pub mod replay;
pub mod space;
mod tick_log;
pub mod wire;
mod worker;

#[cfg(test)]
mod tests;
