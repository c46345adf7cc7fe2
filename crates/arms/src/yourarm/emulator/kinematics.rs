//! Where the flange is, for the emulated controller's Cartesian pose.
//!
//! At zero the upper arm points up and the forearm forward. The joints, from the base on, each after the offset to
//! it [m]:
//!
//! | joint | offset | axis | positive |
//! |---|---|---|---|
//! | 1 | z 0.25 | z | to the left |
//! | 2 | – | y | leans forward |
//! | 3 | z 0.30 | y | forearm down |
//! | 4 | x 0.30 | x | forearm rolls to the right |
//! | 5 | – | y | hand down |
//! | 6 | – | x | hand rolls to the right |
//! | flange | x 0.10 | – | its z axis points out of the hand |

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use std::f64::consts::FRAC_PI_2;

use super::super::protocol::DOF;
use dimos_hardware::sim::reach::Chain;

/// Offset before each joint [m] and the joint's axis.
const JOINTS: [([f64; 3], [f64; 3]); DOF] = [
    ([0.0, 0.0, 0.25], [0.0, 0.0, 1.0]),
    ([0.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
    ([0.0, 0.0, 0.30], [0.0, 1.0, 0.0]),
    ([0.30, 0.0, 0.0], [1.0, 0.0, 0.0]),
    ([0.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
    ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0]),
];
/// Offset of the flange after joint 6 [m].
const FLANGE: [f64; 3] = [0.10, 0.0, 0.0];

/// The arm's links.
pub struct Links;

impl Chain for Links {
    fn link(&self, joint: usize, position: f64) -> Option<Isometry3<f64>> {
        let (offset, axis) = *JOINTS.get(joint)?;
        let turn = UnitQuaternion::from_scaled_axis(Vector3::from(axis) * position);
        Some(Isometry3::from_parts(Translation3::from(Vector3::from(offset)), turn))
    }

    fn axis(&self, joint: usize) -> Vector3<f64> {
        JOINTS.get(joint).map_or(Vector3::z(), |(_, axis)| Vector3::from(*axis))
    }

    fn end(&self) -> Isometry3<f64> {
        let turn = UnitQuaternion::from_scaled_axis(Vector3::y() * FRAC_PI_2);
        Isometry3::from_parts(Translation3::from(Vector3::from(FLANGE)), turn)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_hardware::testing::leads_back;

    #[test]
    fn poses_that_can_be_seen_on_paper() {
        let near = |joints: [f64; DOF], expected: [f64; 3]| {
            let found = Links.forward(&joints).translation.vector;
            assert!((found - Vector3::from(expected)).norm() < 1e-12, "{joints:?}: {found}");
        };
        near([0.0; 6], [0.40, 0.0, 0.55]);
        near([FRAC_PI_2, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0, 0.40, 0.55]);
        near([0.0, FRAC_PI_2, 0.0, 0.0, 0.0, 0.0], [0.30, 0.0, -0.15]);
        near([0.0, 0.0, 0.0, 0.0, FRAC_PI_2, 0.0], [0.30, 0.0, 0.45]);
        let out = Links.forward(&[0.0, 0.0, 0.0, 0.0, FRAC_PI_2, 0.0]).rotation * Vector3::z();
        assert!((out + Vector3::z()).norm() < 1e-12, "the hand points down");
    }

    #[test]
    fn the_inverse_leads_back() {
        assert!(leads_back(&Links, [0.0, -0.3, 0.6, 0.0, 0.8, 0.0], [0.4, -0.1, 0.3, 0.2, 1.0, -0.5]));
    }
}
