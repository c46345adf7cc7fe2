//! Where the arm's end is, for the emulated controller's poses: the vendor's modified Denavit-Hartenberg parameters
//! (those with joints 2 and 3 offset by 2°, as the vendor's SDK has them by default).

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use std::f64::consts::FRAC_PI_2;

use super::super::protocol::DOF;
use crate::hardware::sim::reach::Chain;

/// Per joint: twist [rad] and length [m] of the link before it, offset along its axis [m], zero of its angle [deg].
const LINKS: [(f64, f64, f64, f64); DOF] = [
    (0.0, 0.0, 0.123, 0.0),
    (-FRAC_PI_2, 0.0, 0.0, -172.22),
    (0.0, 0.28503, 0.0, -102.78),
    (FRAC_PI_2, -0.02198, 0.25075, 0.0),
    (-FRAC_PI_2, 0.0, 0.0, 0.0),
    (FRAC_PI_2, 0.0, 0.091, 0.0),
];
/// The arm's links.
pub struct Links;

impl Chain for Links {
    fn link(&self, joint: usize, position: f64) -> Option<Isometry3<f64>> {
        let (twist, length, offset, zero) = *LINKS.get(joint)?;
        let before = UnitQuaternion::from_scaled_axis(Vector3::x() * twist) * Translation3::new(length, 0.0, 0.0);
        let turn = UnitQuaternion::from_scaled_axis(Vector3::z() * (position + zero.to_radians()));
        Some(before * turn * Translation3::new(0.0, 0.0, offset))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hardware::sim::reach::tests::leads_back;
    use crate::pose::to_xyz_rpy;

    /// Poses as the vendor's SDK computes them [mm, deg].
    #[test]
    fn poses_are_the_vendors() {
        for (joints, expected) in [
            ([0.0; 6], [56.1275, 0.0, 213.2663, 0.0, 85.0, 0.0]),
            ([0.1, 0.6, -0.7, 0.05, 0.4, -0.1], [119.1448, 13.7344, 363.413, -167.0061, 77.5146, -159.832]),
            ([-0.5, 1.2, -1.1, 0.7, -0.6, 1.0], [212.5119, -153.8147, 457.3204, 64.5483, -11.3688, 43.0656]),
        ] {
            let ([x, y, z], [roll, pitch, yaw]) = to_xyz_rpy(&Links.forward(&joints));
            let found = [x * 1e3, y * 1e3, z * 1e3, roll.to_degrees(), pitch.to_degrees(), yaw.to_degrees()];
            for (found, expected) in found.iter().zip(expected) {
                assert!((found - expected).abs() < 1e-3, "{joints:?}: {found} is not {expected}");
            }
        }
    }

    #[test]
    fn the_inverse_leads_back() {
        leads_back(&Links, [0.1, 0.6, -0.7, 0.05, 0.4, -0.1], [0.3, 0.9, -0.9, 0.2, 0.6, -0.3]);
    }
}
