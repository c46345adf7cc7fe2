//! Collision checking: robots and obstacles as solids, immutable snapshots of a world, and checkers for planners.
//!
//! ```text
//!  RobotModel ─▶ body ─┐
//!  obstacles ──────────┴▶ World ──snapshot──▶ Arc<Scene> ──▶ ExactChecker: CollisionChecker
//! ```
//!
//! A snapshot never changes: perception, planning and a viewer each keep their own, without locks.

pub mod allowed_pairs;
mod ball;
pub mod body;
pub mod checker;
pub mod clearance;
pub mod cloud;
mod cover;
mod distance_transform;
pub mod exact;
mod field;
mod lanes;
mod motion;
mod outline;
pub mod own_margins;
mod padding;
pub mod pairs;
pub mod ply;
pub mod proven_apart;
pub mod report;
mod revolved;
pub mod scene;
pub mod settings;
pub mod shape;
pub mod sweep;
mod triangle_pair;
mod triangles;
pub mod world;

pub use checker::{CollisionChecker, Stop};
pub use exact::ExactChecker;
pub use own_margins::OwnMargins;
pub use scene::Scene;
pub use settings::CheckSettings;
pub use shape::Solid;
pub use sweep::Sweep;
pub use world::World;

#[cfg(test)]
mod tests;
