//! The arms in the box, one folder each. A new arm is one folder and one line here.

use crate::hardware::registry::AdapterSpec;

pub mod mock;

/// The compile-time adapter table.
pub const TABLE: &[AdapterSpec] = &[mock::SPEC];
pub mod yourarm;
