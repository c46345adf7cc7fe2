//! A set of an arm's joints, and what is known of their efforts.

use serde::{Deserialize, Serialize};

use crate::joint::MAX_DOF;
use crate::named::named;

/// A set of joints of one arm, counted from the base.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct JointSet(u16);

impl JointSet {
    /// No joint.
    pub const NONE: Self = Self(0);

    /// Returns the set of these joints; those beyond [`MAX_DOF`] are left out.
    pub fn of(joints: impl IntoIterator<Item = usize>) -> Self {
        let mut set = Self::NONE;
        joints.into_iter().for_each(|joint| set.insert(joint));
        set
    }

    /// Returns the set with these bits: bit i is joint i.
    pub const fn from_bits(bits: u16) -> Self {
        Self(bits)
    }

    /// Returns its bits.
    pub const fn bits(self) -> u16 {
        self.0
    }

    /// Adds a joint.
    pub fn insert(&mut self, joint: usize) {
        if joint < MAX_DOF {
            self.0 |= 1 << joint;
        }
    }

    /// Returns whether it has a joint.
    pub fn contains(self, joint: usize) -> bool {
        joint < MAX_DOF && self.0 >> joint & 1 != 0
    }

    /// Returns whether it has none.
    pub fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// Returns the joint that is nearest to the base.
    pub fn first(self) -> Option<usize> {
        self.iter().next()
    }

    /// Returns the joints, from the base.
    pub fn iter(self) -> impl Iterator<Item = usize> {
        (0..MAX_DOF).filter(move |joint| self.contains(*joint))
    }
}

named! {
    /// Where the efforts of a reading come from.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum EffortKind {
        /// There are none, or the adapter does not say.
        #[default]
        Unstated = "",
        /// Sensors at the joints measure them.
        Measured = "measured",
        /// The controller computes them from the motors' currents.
        FromCurrent = "from_current",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joints_are_in_a_set_once_and_in_order() {
        let set = JointSet::of([4, 0, 4, 99]);
        assert_eq!(set.iter().collect::<Vec<_>>(), [0, 4]);
        assert!(set.contains(4) && !set.contains(1) && !set.contains(99) && !set.is_empty());
        assert_eq!((set.first(), JointSet::NONE.first(), set.bits()), (Some(0), None, 0b1_0001));
        assert_eq!(JointSet::from_bits(set.bits()), set);
    }
}
