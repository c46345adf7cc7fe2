//! The built-in types of tasks: one folder and one row each.

pub mod cartesian;
pub mod chunk;
pub mod follow;
pub mod servo;
pub mod trajectory;
pub mod velocity;

use super::task_spec::TaskSpec;

/// The built-in types, in the order of the reference.
pub const TABLE: &[TaskSpec] = &[
    trajectory::SPEC,
    servo::SPEC,
    velocity::SPEC,
    chunk::SPEC,
    cartesian::CARTESIAN_IK,
    cartesian::EEF_TWIST,
    follow::SPEC,
];
