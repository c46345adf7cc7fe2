//! From configurations to a path: RRT-Connect over several ranges, shortcuts, refinement, proofs of edges.

pub(in crate::planning) mod candidates;
pub mod edges;
pub mod enclosure;
pub mod level;
pub mod nearest;
pub mod path;
pub mod path_planner;
pub mod portfolio;
pub mod refine;
pub mod rrt_connect;
pub(in crate::planning) mod sampled;
pub mod sampler;
pub mod settings;
pub mod shortcut;
pub mod thin;
