//! Robot descriptions: what is read from URDF, xacro, SRDF and mesh files, as plain data.
//!
//! ```text
//!  .xacro ─▶ xacro ─▶ xml ─▶ urdf ─▶ model        srdf, joint_limits.yaml ─▶ groups, poses, limits
//!  .urdf ──────────▶ xml ──┘    └─ packages ─▶ mesh files ─▶ mesh
//! ```
//!
//! Every element keeps the place it was written at, through includes and macros, so that every mistake is shown there.

pub mod model;
pub mod packages;
pub mod urdf;
pub mod xml;

pub use model::{Geometry, Inertial, Joint, JointKind, Limits, Link, MeshFile, Mimic, RobotModel, Shape};
