//! The arms in the box, one folder each. A new arm is one folder and one line here.

use crate::hardware::registry::AdapterSpec;

pub mod mock;
pub mod yourarm;

/// The compile-time adapter table.
pub const TABLE: &[AdapterSpec] = &[mock::SPEC, yourarm::SPEC];
