//! Where the tool is, for the emulated controller: each joint turns about its own z axis after an offset and a
//! rotation [m, rad: fixed x, y, z], as the makers of the arms publish them.

use std::f64::consts::{FRAC_PI_2, PI};

use nalgebra::{Isometry3, Matrix6, SMatrix, Translation3, UnitQuaternion, Vector3, Vector6};

use super::super::model::Model;

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

/// Most steps of the inverse, when it has arrived [m and rad], and its damping.
const STEPS: usize = 200;
const CLOSE: f64 = 1e-6;
const DAMPING: f64 = 1e-4;

/// A chain of up to seven joints.
#[derive(Debug, Clone, Copy)]
pub struct Chain(&'static [Offset]);

impl Chain {
    /// The chain of a model.
    pub fn of(model: Model) -> Self {
        Self(match model {
            Model::Xarm5 => &XARM5,
            Model::Xarm6 => &XARM6,
            Model::Xarm7 => &XARM7,
            Model::Lite6 => &LITE6,
            Model::Xarm850 => &XARM850,
        })
    }

    /// The tool's pose in the base frame [m] for joint positions [rad].
    pub fn forward(&self, joints: &[f64; 7]) -> Isometry3<f64> {
        self.frames(joints).last().unwrap_or_else(Isometry3::identity)
    }

    /// The frame after each joint.
    fn frames<'a>(&'a self, joints: &'a [f64; 7]) -> impl Iterator<Item = Isometry3<f64>> + 'a {
        let mut pose = Isometry3::identity();
        self.0.iter().zip(joints).map(move |(([x, y, z], [roll, pitch, yaw]), angle)| {
            let turn = UnitQuaternion::from_euler_angles(*roll, *pitch, *yaw);
            pose *= Isometry3::from_parts(Translation3::new(*x, *y, *z), turn);
            pose *= UnitQuaternion::from_scaled_axis(Vector3::z() * *angle);
            pose
        })
    }

    /// Joint positions [rad] near `start` that bring the tool to `goal`, by damped least squares; `None` when that does
    /// not lead there. Knows no joint limits.
    pub fn inverse(&self, goal: &Isometry3<f64>, start: &[f64; 7]) -> Option<[f64; 7]> {
        let mut joints = *start;
        for _ in 0..STEPS {
            let pose = self.forward(&joints);
            let turn = (goal.rotation * pose.rotation.inverse()).scaled_axis();
            let way = goal.translation.vector - pose.translation.vector;
            let error = Vector6::new(way.x, way.y, way.z, turn.x, turn.y, turn.z);
            if error.norm() < CLOSE {
                return Some(joints);
            }
            let jacobian = self.jacobian(&joints);
            let square = jacobian * jacobian.transpose() + Matrix6::identity() * DAMPING;
            let step = jacobian.transpose() * square.cholesky()?.solve(&error);
            let scale = (0.3 / step.amax()).min(1.0);
            joints.iter_mut().zip(step.iter()).for_each(|(joint, d)| *joint += d * scale);
        }
        None
    }

    /// How the tool moves [m, rad] per joint [rad].
    fn jacobian(&self, joints: &[f64; 7]) -> SMatrix<f64, 6, 7> {
        let tool = self.forward(joints).translation.vector;
        let mut jacobian = SMatrix::<f64, 6, 7>::zeros();
        for (frame, mut column) in self.frames(joints).zip(jacobian.column_iter_mut()) {
            let axis = frame.rotation * Vector3::z();
            let linear = axis.cross(&(tool - frame.translation.vector));
            column.copy_from_slice(&[linear.x, linear.y, linear.z, axis.x, axis.y, axis.z]);
        }
        jacobian
    }
}

/// x, y, z [mm], roll, pitch, yaw [rad] (R = Rz·Ry·Rx) of a pose.
pub fn to_wire(pose: &Isometry3<f64>) -> [f32; 6] {
    let (v, (roll, pitch, yaw)) = (pose.translation.vector * 1000.0, pose.rotation.euler_angles());
    [v.x, v.y, v.z, roll, pitch, yaw].map(|value| value as f32)
}

/// The pose of x, y, z [mm], roll, pitch, yaw [rad].
pub fn from_wire(values: [f32; 6]) -> Isometry3<f64> {
    let [x, y, z, roll, pitch, yaw] = values.map(f64::from);
    let place = Translation3::new(x / 1000.0, y / 1000.0, z / 1000.0);
    Isometry3::from_parts(place, UnitQuaternion::from_euler_angles(roll, pitch, yaw))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zero_poses_are_those_of_the_makers() {
        for (model, expected) in [
            (Model::Xarm5, [0.207, 0.0, 0.112]),
            (Model::Xarm6, [0.207, 0.0, 0.112]),
            (Model::Xarm7, [0.206, 0.0, 0.1205]),
            (Model::Lite6, [0.087, 0.0, 0.1542]),
            (Model::Xarm850, [0.15, 0.0, 0.238]),
        ] {
            let pose = Chain::of(model).forward(&[0.0; 7]);
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
            let chain = Chain::of(model);
            let start = [0.1, 0.2, if model == Model::Lite6 { 1.0 } else { -1.0 }, 0.3, 0.8, 0.2, 0.1];
            let there = start.map(|angle| angle + 0.1);
            let goal = from_wire(to_wire(&chain.forward(&there)));
            let found = chain.inverse(&goal, &start).unwrap();
            assert!((chain.forward(&found).translation.vector - goal.translation.vector).norm() < 1e-5);
            assert_eq!(chain.inverse(&from_wire([5000.0, 0.0, 0.0, 0.0, 0.0, 0.0]), &start), None);
        }
    }
}
