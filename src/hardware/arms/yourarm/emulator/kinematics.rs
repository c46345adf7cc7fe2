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

use nalgebra::{Isometry3, Matrix6, Translation3, UnitQuaternion, Vector3, Vector6};
use std::f64::consts::FRAC_PI_2;

use super::super::protocol::DOF;

/// Where joints 1 and 2 meet [m].
const SHOULDER: [f64; 3] = [0.0, 0.0, 0.25];
/// Offset before each joint [m] and the joint's axis.
const JOINTS: [([f64; 3], [f64; 3]); DOF] = [
    (SHOULDER, [0.0, 0.0, 1.0]),
    ([0.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
    ([0.0, 0.0, 0.30], [0.0, 1.0, 0.0]),
    ([0.30, 0.0, 0.0], [1.0, 0.0, 0.0]),
    ([0.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
    ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0]),
];
/// Offset of the flange after joint 6 [m].
const FLANGE: [f64; 3] = [0.10, 0.0, 0.0];
/// Most steps of the inverse, and when it has arrived [m and rad].
const STEPS: usize = 60;
const CLOSE: f64 = 1e-6;
/// Farther than this from joint 2 nothing is in reach [m].
const REACH: f64 = 0.70;
/// Damping of the inverse.
const DAMPING: f64 = 1e-4;

/// The flange's pose in the base frame [m] for joint positions [rad].
pub fn forward(joints: &[f64; DOF]) -> Isometry3<f64> {
    let mut pose = Isometry3::identity();
    for ((offset, axis), angle) in JOINTS.iter().zip(joints) {
        pose *= Translation3::from(Vector3::from(*offset));
        pose *= UnitQuaternion::from_scaled_axis(Vector3::from(*axis) * *angle);
    }
    pose * Translation3::from(Vector3::from(FLANGE)) * UnitQuaternion::from_scaled_axis(Vector3::y() * FRAC_PI_2)
}

/// Joint positions [rad] near `start` that bring the flange to `goal`, by damped least squares; `None` when that
/// does not lead there. Knows no joint limits.
pub fn inverse(goal: &Isometry3<f64>, start: &[f64; DOF]) -> Option<[f64; DOF]> {
    if (goal.translation.vector - Vector3::from(SHOULDER)).norm() > REACH {
        return None;
    }
    let mut joints = *start;
    for _ in 0..STEPS {
        let pose = forward(&joints);
        let turn = (goal.rotation * pose.rotation.inverse()).scaled_axis();
        let way = goal.translation.vector - pose.translation.vector;
        let error = Vector6::new(way.x, way.y, way.z, turn.x, turn.y, turn.z);
        if error.norm() < CLOSE {
            return Some(joints);
        }
        let jacobian = jacobian(&joints);
        let square = jacobian * jacobian.transpose() + Matrix6::identity() * DAMPING;
        let step = jacobian.transpose() * square.cholesky()?.solve(&error);
        let scale = (0.3 / step.amax()).min(1.0);
        joints.iter_mut().zip(step.iter()).for_each(|(joint, d)| *joint += d * scale);
    }
    None
}

/// How the flange moves [m, rad] per joint [rad].
fn jacobian(joints: &[f64; DOF]) -> Matrix6<f64> {
    let flange = forward(joints).translation.vector;
    let mut jacobian = Matrix6::zeros();
    let mut pose = Isometry3::identity();
    for (((offset, axis), angle), mut column) in JOINTS.iter().zip(joints).zip(jacobian.column_iter_mut()) {
        pose *= Translation3::from(Vector3::from(*offset));
        let axis_here = pose.rotation * Vector3::from(*axis);
        let linear = axis_here.cross(&(flange - pose.translation.vector));
        column.copy_from_slice(&[linear.x, linear.y, linear.z, axis_here.x, axis_here.y, axis_here.z]);
        pose *= UnitQuaternion::from_scaled_axis(Vector3::from(*axis) * *angle);
    }
    jacobian
}

/// x, y, z [m], roll, pitch, yaw [rad] (R = Rz·Ry·Rx) of a pose.
pub fn to_values(pose: &Isometry3<f64>) -> [f64; 6] {
    let (v, (roll, pitch, yaw)) = (pose.translation.vector, pose.rotation.euler_angles());
    [v.x, v.y, v.z, roll, pitch, yaw]
}

/// The pose of x, y, z [m], roll, pitch, yaw [rad].
pub fn from_values([x, y, z, roll, pitch, yaw]: [f64; 6]) -> Isometry3<f64> {
    Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::from_euler_angles(roll, pitch, yaw))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_that_can_be_seen_on_paper() {
        let near = |joints, expected: [f64; 3]| {
            let found = forward(&joints).translation.vector;
            assert!((found - Vector3::from(expected)).norm() < 1e-12, "{joints:?}: {found}");
        };
        near([0.0; 6], [0.40, 0.0, 0.55]);
        near([FRAC_PI_2, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0, 0.40, 0.55]);
        near([0.0, FRAC_PI_2, 0.0, 0.0, 0.0, 0.0], [0.30, 0.0, -0.15]);
        near([0.0, 0.0, 0.0, 0.0, FRAC_PI_2, 0.0], [0.30, 0.0, 0.45]);
        let out = forward(&[0.0, 0.0, 0.0, 0.0, FRAC_PI_2, 0.0]).rotation * Vector3::z();
        assert!((out + Vector3::z()).norm() < 1e-12, "the hand points down");
    }

    #[test]
    fn the_inverse_leads_back() {
        let (start, there) = ([0.0, -0.3, 0.6, 0.0, 0.8, 0.0], [0.4, -0.1, 0.3, 0.2, 1.0, -0.5]);
        let goal = from_values(to_values(&forward(&there)));
        let found = inverse(&goal, &start).unwrap();
        assert!((forward(&found).translation.vector - goal.translation.vector).norm() < 1e-5);
        let far = from_values([2.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(inverse(&far, &start), None);
    }
}
