//! Owns located trees: every mistake of a file at its line. Never knows what a key means. Used by whatever reads files
//! that people write.
//!
//! YAML reader that reports all mistakes at once, each with its position. Independent of robotics.
//!
//! ```text
//!  text ─▶ parse ─▶ Tree ─▶ merge (includes) ─▶ set (arguments) ─▶ read::<T> ─▶ T, and skipped nodes
//!                   └─ every node keeps its source and range; every mistake becomes a Diag ─▶ render | JSON
//! ```
//!
//! Three concepts:
//! * a **located tree**: nodes keep their position, also after merging includes and `--set`;
//! * **error recovery**: [`read`] records an error, works around it and reads again until no error is left;
//! * [`Located`] values, so that later checks can also point at the exact position.

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::unreachable))]
#![forbid(unsafe_code)]
#![allow(rustdoc::broken_intra_doc_links, reason = "units are in brackets: [rad]")]

mod access;
mod de;
mod diag;
mod error;
mod keys;
mod located;
mod merge;
mod parse;
mod placeholder;
pub mod range;
mod recovery;
mod render;
mod scalar;
mod set;
mod suggest;
mod tree;

pub use diag::{Diag, Label, Report, Severity};
pub use keys::keys;
pub use located::{Keyed, Located, Raw, Text};
pub use merge::{MergeRules, merge};
pub use recovery::{Lost, Missing, read};
pub use render::render;
pub use set::set;
pub use suggest::{closest, did_you_mean, quote};
pub use tree::{Kind, MAX_BYTES, MAX_DEPTH, MAX_NODES, NOWHERE, Node, NodeId, SourceId, Tree};

use serde::de::DeserializeOwned;

/// Reports every mistake found by reading `node` as `T`.
pub fn check<T: DeserializeOwned>(tree: &mut Tree, node: NodeId) {
    read::<T>(tree, node, Missing::Report);
}
