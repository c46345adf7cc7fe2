//! Owns slots, wake-ups, scheduling and the locking of memory. Never knows arms. Used by device threads and the run.
//!
//! Real-time primitives: latest-value slots, wake-ups, scheduling, memory; and names that the kernel keeps. Only this
//! crate and `dimos-kernels` have `unsafe`.

#![cfg_attr(
    not(test),
    deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::unreachable, clippy::indexing_slicing)
)]
#![allow(rustdoc::broken_intra_doc_links, reason = "units are in brackets: [rad]")]

pub mod abstract_name;
pub mod arrival;
pub mod counting;
pub mod due;
pub mod heartbeat;
pub mod histogram;
pub mod host;
pub mod slot;
pub mod socket_list;
pub mod wake;
