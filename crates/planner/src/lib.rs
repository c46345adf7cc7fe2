//! Owns the search for motions: scene and collision, search, timing, inverse kinematics, requests, and the thread that
//! answers them. Never knows control or hardware. Used by the run, and by programs that only plan.

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::unreachable))]
#![forbid(unsafe_code)]
#![allow(rustdoc::broken_intra_doc_links, reason = "units are in brackets: [rad]")]

pub mod collision;
pub mod planning;
