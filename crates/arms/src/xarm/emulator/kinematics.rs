//! Where the tool is, for the emulated controller: each joint turns about its own z axis after an offset and a
//! rotation [m, rad: fixed x, y, z], as the makers of the arms publish them.

use std::f64::consts::{FRAC_PI_2, PI};

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use super::super::model::Model;
use dimos_core::pose::{from_xyz_rpy, to_xyz_rpy};
use dimos_hardware::sim::reach::Chain;

type Offset = ([f64; 3], [f64; 3]);

const DOWN: [f64; 3] = [-FRAC_PI_2, 0.0, 0.0];
const UP: [f64; 3] = [FRAC_PI_2, 0.0, 0.0];
const SAME: [f64; 3] = [0.0; 3];
const SHOULDER_LITE: [f64; 3] = [FRAC_PI_2, -FRAC_PI_2, PI];
const ELBOW_LITE: [f64; 3] = [-PI, 0.0, FRAC_PI_2];

const XARM5: [Offset; 5] = [
    ([0.0, 0.0, 0.267], SAME),
    ([0.0; 3], DOWN),
    ([0.0535, -0.2845, 0.0], SAME),
    ([0.0775, 0.3425, 0.0], SAME),
    ([0.076, 0.097, 0.0], DOWN),
];
const XARM6: [Offset; 6] = [
    ([0.0, 0.0, 0.267], SAME),
    ([0.0; 3], DOWN),
    ([0.0535, -0.2845, 0.0], SAME),
    ([0.0775, 0.3425, 0.0], DOWN),
    ([0.0; 3], UP),
    ([0.076, 0.097, 0.0], DOWN),
];
const XARM7: [Offset; 7] = [
    ([0.0, 0.0, 0.267], SAME),
    ([0.0; 3], DOWN),
    ([0.0, -0.293, 0.0], UP),
    ([0.0525, 0.0, 0.0], UP),
    ([0.0775, -0.3425, 0.0], UP),
    ([0.0; 3], UP),
    ([0.076, 0.097, 0.0], DOWN),
];
const LITE6: [Offset; 6] = [
    ([0.0, 0.0, 0.2433], SAME),
    ([0.0; 3], SHOULDER_LITE),
    ([0.2, 0.0, 0.0], ELBOW_LITE),
    ([0.087, -0.2276, 0.0], UP),
    ([0.0; 3], UP),
    ([0.0, 0.0615, 0.0], DOWN),
];
const XARM850: [Offset; 6] = [
    ([0.0, 0.0, 0.364], SAME),
    ([0.0; 3], SHOULDER_LITE),
    ([0.39, 0.0, 0.0], ELBOW_LITE),
    ([0.15, -0.426, 0.0], UP),
    ([0.0; 3], DOWN),
    ([0.0, -0.09, 0.0], UP),
];

/// The links of up to seven joints.
#[derive(Debug, Clone, Copy)]
pub struct Links(&'static [Offset]);

impl Links {
    /// The links of a model.
    pub fn of(model: Model) -> Self {
        Self(match model {
            Model::Xarm5 => &XARM5,
            Model::Xarm6 => &XARM6,
            Model::Xarm7 => &XARM7,
            Model::Lite6 => &LITE6,
            Model::Xarm850 => &XARM850,
        })
    }
}

impl Chain for Links {
    fn link(&self, joint: usize, position: f64) -> Option<Isometry3<f64>> {
        let ([x, y, z], [roll, pitch, yaw]) = *self.0.get(joint)?;
        let turn = UnitQuaternion::from_scaled_axis(Vector3::z() * position);
        Some(from_xyz_rpy([x, y, z], [roll, pitch, yaw]) * turn)
    }
}

/// x, y, z [mm], roll, pitch, yaw [rad] (R = Rz·Ry·Rx) of a pose.
pub fn to_wire(pose: &Isometry3<f64>) -> [f32; 6] {
    let ([x, y, z], [roll, pitch, yaw]) = to_xyz_rpy(pose);
    [x * 1000.0, y * 1000.0, z * 1000.0, roll, pitch, yaw].map(|value| value as f32)
}

/// x, y, z [mm] and the rotation vector [rad] of a pose.
pub fn to_wire_axis_angle(pose: &Isometry3<f64>) -> [f32; 6] {
    let [x, y, z]: [f64; 3] = pose.translation.vector.into();
    let turn = pose.rotation.scaled_axis();
    [x * 1000.0, y * 1000.0, z * 1000.0, turn.x, turn.y, turn.z].map(|value| value as f32)
}

/// The pose of x, y, z [mm] and a rotation vector [rad].
pub fn from_wire_axis_angle(values: [f32; 6]) -> Isometry3<f64> {
    let [x, y, z, a, b, c] = values.map(f64::from);
    let place = Translation3::new(x / 1000.0, y / 1000.0, z / 1000.0);
    Isometry3::from_parts(place, UnitQuaternion::from_scaled_axis(Vector3::new(a, b, c)))
}

/// The pose of x, y, z [mm], roll, pitch, yaw [rad].
pub fn from_wire(values: [f32; 6]) -> Isometry3<f64> {
    let [x, y, z, roll, pitch, yaw] = values.map(f64::from);
    from_xyz_rpy([x, y, z].map(|v| v / 1000.0), [roll, pitch, yaw])
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_hardware::testing::leads_back;

    #[test]
    fn zero_poses_are_those_of_the_makers() {
        for (model, expected) in [
            (Model::Xarm5, [0.207, 0.0, 0.112]),
            (Model::Xarm6, [0.207, 0.0, 0.112]),
            (Model::Xarm7, [0.206, 0.0, 0.1205]),
            (Model::Lite6, [0.087, 0.0, 0.1542]),
            (Model::Xarm850, [0.15, 0.0, 0.238]),
        ] {
            let pose = Links::of(model).forward(&[0.0; 7]);
            let off = (pose.translation.vector - Vector3::from(expected)).norm();
            assert!(off < 1e-9, "{model:?}: {:?}", pose.translation);
            let (x, z) = model.zero_pose();
            assert!((x / 1000.0 - expected[0]).abs() + (z / 1000.0 - expected[2]).abs() < 1e-9, "{model:?}");
            let out = pose.rotation * Vector3::z();
            assert!((out + Vector3::z()).norm() < 1e-9, "{model:?}: the hand points down, not {out}");
        }
    }

    #[test]
    fn the_inverse_leads_back() {
        for model in [Model::Xarm6, Model::Xarm7, Model::Lite6, Model::Xarm850] {
            let start = [0.1, 0.2, if model == Model::Lite6 { 1.0 } else { -1.0 }, 0.3, 0.8, 0.2, 0.1];
            assert!(leads_back(&Links::of(model), start, start.map(|angle| angle + 0.1)));
        }
    }
}
