//! Owns the vocabulary of dimos: joints and their limits, states and setpoints, trajectories, poses, time, errors with
//! hints. Never does I/O, never starts a thread. Used by every other crate.

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::unreachable))]
#![forbid(unsafe_code)]
#![allow(rustdoc::broken_intra_doc_links, reason = "units are in brackets: [rad]")]

pub mod arm;
pub mod bounded;
pub mod clock;
pub mod double_s;
pub mod joint;
pub mod message;
pub mod named;
pub mod pose;
pub mod random;
pub mod sync;
pub mod telemetry;
pub mod trajectory;
pub mod until;
pub mod written;
