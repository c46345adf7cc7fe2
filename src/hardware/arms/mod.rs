//! The built-in arms, one folder each. A new arm is one folder and one line here.

use crate::hardware::registry::{Absent, AdapterSpec};

pub mod mock;
pub mod piper;
pub mod remote;
pub mod xarm;
pub mod yourarm;

/// The compile-time adapter table.
pub const TABLE: &[AdapterSpec] = &[mock::SPEC, yourarm::SPEC, xarm::SPEC, piper::SPEC, remote::SPEC];

/// The adapters that this build does not have: those behind a cargo feature that is off. None of the box is.
pub const ABSENT: &[Absent] = &[];
