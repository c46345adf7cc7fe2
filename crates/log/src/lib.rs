//! Owns logs: ROS 2 messages, the recorder, the readers. Never delays the tick. Used by the run, and by the tools for
//! logs.
//!
//! Recording: a run's log is an MCAP file that ROS 2 tools, Foxglove, PlotJuggler and rerun open.
//!
//! ```text
//! tick ──ring──▶ recorder (thread) ─▶ tick_log (samples → messages) ─▶ log_writer (MCAP) ─▶ file
//! rpc ──notes──┘        └─▶ notices: events as text, for rpc and the terminal        replay ◀─┘
//! ```
//!
//! Contents of a log and guarantees for readers: `docs/log-format.md`.

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::unreachable))]
#![forbid(unsafe_code)]
#![allow(rustdoc::broken_intra_doc_links, reason = "units are in brackets: [rad]")]

mod arm_messages;
mod askers;
pub mod attachment;
pub mod cdr;
mod channels;
pub mod chunk;
mod chunk_index;
pub mod disk_space;
mod disk_sync;
pub mod display_messages;
mod entries;
mod fault_ring;
pub mod files;
pub mod joints;
pub mod log_writer;
mod long_log;
pub mod loss;
pub mod messages;
pub mod node_messages;
pub mod notes;
mod open_files;
mod packed_samples;
mod pending_executes;
pub mod recorder;
pub mod records;
pub mod replay;
pub mod rewrite;
pub mod robots;
pub mod ros2msg;
pub mod scan;
mod scene_log;
pub mod source;
pub mod source_files;
pub mod storage;
pub mod tcp_log;
mod tick_log;
pub mod window;
pub mod wire;
mod worker;

#[cfg(test)]
mod tests;

/// Key of the config version in a log's metadata.
pub const CONFIG_VERSION_KEY: &str = "config_version";
/// Key in the metadata of a log in several files, from the second on: the number of the file, from 1.
pub const PART: &str = "part";
/// Name of the metadata at the end of a file that another one continues, and their key for its name.
pub const CONTINUES: &str = "continues";
/// Name of the attachment with the coordinator's configuration.
pub const COORDINATOR: &str = "coordinator.json";
