//! Owns robot descriptions (URDF, xacro, SRDF, meshes, packages), their kinematics and dynamics. Never knows other
//! robots, obstacles or time. Used by the planner, the control and the log.
//!
//! Robot descriptions: URDF, xacro, SRDF and mesh files as plain data.
//!
//! ```text
//!  .xacro ─▶ xacro ─▶ xml ─▶ urdf ─▶ model        srdf, joint_limits.yaml ─▶ groups, poses, limits
//!  .urdf ──────────▶ xml ──┘    └─ packages ─▶ mesh files ─▶ mesh
//! ```
//!
//! Every element keeps its position in the source, through includes and macros, so that diagnostics point at it.

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::unreachable))]
#![forbid(unsafe_code)]
#![allow(rustdoc::broken_intra_doc_links, reason = "units are in brackets: [rad]")]

pub mod builtin;
pub mod calibrated;
pub mod dynamics;
mod encoding;
pub mod interchange;
mod joint_limits;
mod judge;
pub mod kinematics;
mod load;
pub mod mesh;
pub mod mjcf;
pub mod model;
pub mod packages;
pub mod random;
pub mod srdf;
pub mod urdf;
pub mod xacro;
pub mod xml;

pub use judge::judge;
pub use load::{Loaded, Source, load};
pub use model::{Geometry, Inertial, Joint, JointKind, Limits, Link, MeshFile, Mimic, RobotModel, Shape};

/// A small generator for tests: the same seed gives the same numbers.
#[cfg(test)]
fn test_random(seed: u64) -> impl FnMut() -> u64 {
    let mut state = seed;
    move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        state >> 33
    }
}
