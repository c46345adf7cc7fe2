//! Owns the search for motions: scene and collision, search, timing, inverse kinematics, requests. Never knows control
//! or hardware, never starts a thread: the run gives it one. Used by the run, and by programs that only
//! plan.

#![forbid(unsafe_code)]
#![allow(rustdoc::broken_intra_doc_links, reason = "units are in brackets: [rad]")]

pub mod collision;
pub mod planning;
