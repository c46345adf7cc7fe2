//! The arms in the box, one folder each. A new arm is one folder and one line here.

use crate::hardware::registry::{Absent, AdapterSpec};

pub mod mock;
#[cfg(feature = "can")]
pub mod piper;
pub mod remote;
pub mod xarm;
pub mod yourarm;

/// The compile-time adapter table.
pub const TABLE: &[AdapterSpec] = &[
    mock::SPEC,
    yourarm::SPEC,
    xarm::SPEC,
    #[cfg(feature = "can")]
    piper::SPEC,
    remote::SPEC,
];

/// The adapters that a build may lack, with the way to get them. Those that are in the table are not lacking.
pub const ABSENT: &[Absent] =
    &[Absent { name: "piper", about: "AgileX Piper, 6 joints and gripper", remedy: "build with --features can" }];
