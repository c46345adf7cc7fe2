//! placeholder, replaced by the real reader
/// A located YAML tree.
pub struct Tree;
/// A node of it.
pub type NodeId = u32;
/// Reports every mistake that reading `node` as `T` shows.
pub fn check<T: serde::de::DeserializeOwned>(_tree: &mut Tree, _node: NodeId) {}
