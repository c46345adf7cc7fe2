//! The arms in the box, one folder each. A new arm is one folder and one line here.

use crate::hardware::registry::{Absent, AdapterSpec};

pub mod mock;
pub mod remote;
pub mod yourarm;

/// The compile-time adapter table.
pub const TABLE: &[AdapterSpec] = &[mock::SPEC, remote::SPEC, yourarm::SPEC];

/// The adapters that this build does not have.
pub const ABSENT: &[Absent] = &[];
