//! The built-in arms, one folder each. A new arm is one folder and one line here.

use crate::hardware::registry::{Absent, AdapterSpec};

pub mod franka;
pub mod mock;
pub mod piper;
pub mod remote;
pub mod so101;
pub mod ur;
pub mod xarm;
pub mod yourarm;

/// The compile-time adapter table.
pub const TABLE: &[AdapterSpec] =
    &[mock::SPEC, yourarm::SPEC, xarm::SPEC, piper::SPEC, so101::SPEC, ur::SPEC, franka::SPEC, remote::SPEC];

/// Adapters that this build lacks because their cargo feature is off. No built-in adapter has one.
pub const ABSENT: &[Absent] = &[];
