//! Reads YAML so that every mistake is found at once, each at its place. Knows nothing of arms.
//!
//! ```text
//! text ─▶ parse ─▶ Tree ─▶ merge (includes) ─▶ set (arguments) ─▶ read::<T> ─▶ T, and what was lost on the way
//!                   └─ every node keeps its source and range; every mistake becomes a Diag ─▶ render | JSON
//! ```
//!
//! Three ideas carry it:
//! * a **located tree**: nodes know where they were written, also after includes and `--set` were merged in;
//! * **healing**: [`read`] notes an error, works round it and reads again, until nothing is left to report;
//! * [`Located`] values, so that whoever checks the meaning afterwards can point at the exact place too.

mod access;
mod de;
mod diag;
mod error;
mod heal;
mod keys;
mod located;
mod merge;
mod parse;
pub mod range;
mod render;
mod scalar;
mod set;
mod stand_in;
mod suggest;
mod tree;

pub use diag::{Diag, Label, Report, Severity};
pub use heal::{Lost, Missing, read};
pub use keys::keys;
pub use located::{Keyed, Located, Raw, Text};
pub use merge::{MergeRules, merge};
pub use render::render;
pub use set::set;
pub use suggest::{closest, did_you_mean, quote};
pub use tree::{Kind, MAX_BYTES, MAX_DEPTH, MAX_NODES, NOWHERE, Node, NodeId, SourceId, Tree};

use serde::de::DeserializeOwned;

/// Reports every mistake that reading `node` as `T` shows.
pub fn check<T: DeserializeOwned>(tree: &mut Tree, node: NodeId) {
    read::<T>(tree, node, Missing::Report);
}
