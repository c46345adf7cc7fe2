//! Owns the contract with an arm: adapters, device threads, transports, the kit of emulators, conformance. Never knows
//! an arm. Used by each adapter, in this repository or outside, and by the run.

#![cfg_attr(
    not(test),
    deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::unreachable, clippy::indexing_slicing)
)]
#![forbid(unsafe_code)]
#![allow(rustdoc::broken_intra_doc_links, reason = "units are in brackets: [rad]")]

/// What the contract is written in; so an adapter needs no other crate of dimos.
pub use dimos_core::{arm, clock, joint};
/// An allocator that counts, for an adapter's own conformance test.
pub use dimos_rt::counting;

pub mod adapter;
pub mod adapter_util;
pub mod check;
pub mod conformance;
pub mod device;
pub mod peripheral;
pub mod registry;
pub mod service;
pub mod sim;
pub mod testing;
pub mod transport;
pub mod wire;
