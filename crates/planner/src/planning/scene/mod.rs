//! The planning scene: robots and obstacles as configured and as computed with, joints that are not planned, padding.

pub mod config;
pub mod ignored_pairs;
pub mod padded;
pub mod planning_scene;
mod proofs;
pub mod settings;
pub(in crate::planning) mod stage_cache;
pub mod unplanned_joints;
