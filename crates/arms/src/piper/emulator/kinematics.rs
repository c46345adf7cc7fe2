//! Where the arm's end is, for the emulated controller's poses: the vendor's modified Denavit-Hartenberg parameters
//! (those with joints 2 and 3 offset by 2°, as the vendor's SDK has them by default).

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use std::f64::consts::FRAC_PI_2;

use super::super::model::Model;
use super::super::protocol::DOF;
use dimos_core::pose::from_xyz_rpy;
use dimos_hardware::sim::reach::Chain;

/// Per joint: twist [rad] and length [m] of the link before it, offset along its axis [m], zero of its angle [deg].
const LINKS: [(f64, f64, f64, f64); DOF] = [
    (0.0, 0.0, 0.123, 0.0),
    (-FRAC_PI_2, 0.0, 0.0, -172.22),
    (0.0, 0.28503, 0.0, -102.78),
    (FRAC_PI_2, -0.02198, 0.25075, 0.0),
    (-FRAC_PI_2, 0.0, 0.0, 0.0),
    (FRAC_PI_2, 0.0, 0.091, 0.0),
];
/// x, y, z [m] and roll, pitch, yaw [rad] of each joint in the one before, as the vendor's descriptions have them
/// (agx_arm_urdf).
type Origins = [([f64; 3], [f64; 3]); DOF];

const PI: f64 = std::f64::consts::PI;
/// Joint 2 of Piper-H and -L, and the zero of their joint 3.
const SHOULDER: ([f64; 3], [f64; 3]) = ([0.0; 3], [FRAC_PI_2, -0.1357866, -PI]);
const ELBOW: f64 = -1.7938494;
const PIPER_H: Origins = [
    ([0.0, 0.0, 0.123], [0.0; 3]),
    SHOULDER,
    ([0.28503, 0.0, 0.0], [0.0, 0.0, ELBOW]),
    ([-0.02198, -0.25575, 0.0], [FRAC_PI_2, 0.0, 0.0]),
    ([0.0; 3], [-FRAC_PI_2, 0.0, 0.0]),
    ([0.0, -0.0963, 0.0], [FRAC_PI_2, 0.0, 0.0]),
];
const PIPER_L: Origins = [
    ([0.0, 0.0, 0.123], [0.0; 3]),
    SHOULDER,
    ([0.33823, 0.0, 0.0], [0.0, 0.0, ELBOW]),
    ([-0.02301, -0.32075, 0.0], [FRAC_PI_2, 0.0, 0.0]),
    ([0.0; 3], [-FRAC_PI_2, 0.0, 0.0]),
    ([0.0, -0.091, 0.0], [FRAC_PI_2, 0.0, 0.0]),
];
const PIPER_X: Origins = [
    ([0.0, 0.0, 0.123], [0.0, 0.0, PI]),
    ([0.0; 3], [-FRAC_PI_2, -3.005806, -PI]),
    ([0.28503, 0.0, 0.0], [0.0, 0.0, 2.8380798]),
    ([0.27364, 0.0, 0.0], [0.0, 0.0, 0.0806342]),
    ([0.07466, 0.0, 0.0], [-FRAC_PI_2, FRAC_PI_2, 0.0]),
    ([0.0, -0.035, 0.0], [FRAC_PI_2, 0.0, 0.0]),
];

/// The links of a model.
pub struct Links(pub Model);

impl Chain for Links {
    fn link(&self, joint: usize, position: f64) -> Option<Isometry3<f64>> {
        let origins = match self.0 {
            Model::Piper => None,
            Model::PiperH => Some(&PIPER_H),
            Model::PiperL => Some(&PIPER_L),
            Model::PiperX => Some(&PIPER_X),
        };
        if let Some(origins) = origins {
            let (xyz, rpy) = *origins.get(joint)?;
            return Some(from_xyz_rpy(xyz, rpy) * UnitQuaternion::from_scaled_axis(Vector3::z() * position));
        }
        let (twist, length, offset, zero) = *LINKS.get(joint)?;
        let before = UnitQuaternion::from_scaled_axis(Vector3::x() * twist) * Translation3::new(length, 0.0, 0.0);
        let turn = UnitQuaternion::from_scaled_axis(Vector3::z() * (position + zero.to_radians()));
        Some(before * turn * Translation3::new(0.0, 0.0, offset))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_core::pose::to_xyz_rpy;
    use dimos_hardware::testing::leads_back;

    /// Poses as the vendor's SDK computes them [mm, deg].
    #[test]
    fn poses_are_the_vendors() {
        for (joints, expected) in [
            ([0.0; 6], [56.1275, 0.0, 213.2663, 0.0, 85.0, 0.0]),
            ([0.1, 0.6, -0.7, 0.05, 0.4, -0.1], [119.1448, 13.7344, 363.413, -167.0061, 77.5146, -159.832]),
            ([-0.5, 1.2, -1.1, 0.7, -0.6, 1.0], [212.5119, -153.8147, 457.3204, 64.5483, -11.3688, 43.0656]),
        ] {
            let ([x, y, z], [roll, pitch, yaw]) = to_xyz_rpy(&Links(Model::Piper).forward(&joints));
            let found = [x * 1e3, y * 1e3, z * 1e3, roll.to_degrees(), pitch.to_degrees(), yaw.to_degrees()];
            for (found, expected) in found.iter().zip(expected) {
                assert!((found - expected).abs() < 1e-3, "{joints:?}: {found} is not {expected}");
            }
        }
    }

    /// Stretched straight up, each is as high as its links are long.
    #[test]
    fn the_models_reach_as_far_as_their_links() {
        let reach = |model: Model| {
            let mut furthest = 0.0_f64;
            for k in 0..400 {
                let joints = [0.0, 0.01 * f64::from(k), -1.75, 0.0, 0.0, 0.0];
                let end = Links(model).forward(&joints).translation.vector;
                furthest = furthest.max((end - Vector3::new(0.0, 0.0, 0.123)).norm());
            }
            furthest
        };
        let [piper, h, l] = [Model::Piper, Model::PiperH, Model::PiperL].map(reach);
        assert!((0.005..0.02).contains(&(h - piper)) && (0.1..0.13).contains(&(l - piper)), "{piper} {h} {l}");
        assert!(reach(Model::PiperX) > 0.5);
    }

    #[test]
    fn the_inverse_leads_back() {
        for model in [Model::PiperH, Model::PiperL, Model::PiperX] {
            assert!(leads_back(&Links(model), [0.1, 0.6, -0.7, 0.05, 0.4, -0.1], [0.3, 0.9, -0.9, 0.2, 0.6, -0.3]));
        }
        assert!(leads_back(&Links(Model::Piper), [0.1, 0.6, -0.7, 0.05, 0.4, -0.1], [0.3, 0.9, -0.9, 0.2, 0.6, -0.3]));
    }
}
