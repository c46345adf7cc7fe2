//! Where the arm's end is, for the emulated controller's poses: the vendor's modified Denavit-Hartenberg parameters
//! (those with joints 2 and 3 offset by 2°, as the vendor's SDK has them by default).

use nalgebra::{Isometry3, Matrix6, Translation3, UnitQuaternion, Vector3, Vector6};
use std::f64::consts::FRAC_PI_2;

use super::super::protocol::DOF;

/// Per joint: twist [rad] and length [m] of the link before it, offset along its axis [m], zero of its angle [deg].
const LINKS: [(f64, f64, f64, f64); DOF] = [
    (0.0, 0.0, 0.123, 0.0),
    (-FRAC_PI_2, 0.0, 0.0, -172.22),
    (0.0, 0.28503, 0.0, -102.78),
    (FRAC_PI_2, -0.02198, 0.25075, 0.0),
    (-FRAC_PI_2, 0.0, 0.0, 0.0),
    (FRAC_PI_2, 0.0, 0.091, 0.0),
];
/// Most steps of the inverse, and when it has arrived [m and rad].
const STEPS: usize = 60;
const CLOSE: f64 = 1e-6;
/// Damping of the inverse.
const DAMPING: f64 = 1e-4;

/// The frames of all joints in the base frame [m], the end's last, for joint positions [rad].
fn frames(joints: &[f64; DOF]) -> [Isometry3<f64>; DOF] {
    let mut pose = Isometry3::identity();
    let mut all = [pose; DOF];
    for ((frame, (twist, length, offset, zero)), angle) in all.iter_mut().zip(LINKS).zip(joints) {
        pose *= UnitQuaternion::from_scaled_axis(Vector3::x() * twist);
        pose *= Translation3::new(length, 0.0, 0.0);
        pose *= UnitQuaternion::from_scaled_axis(Vector3::z() * (angle + zero.to_radians()));
        pose *= Translation3::new(0.0, 0.0, offset);
        *frame = pose;
    }
    all
}

/// The end's pose in the base frame [m] for joint positions [rad].
pub fn forward(joints: &[f64; DOF]) -> Isometry3<f64> {
    let [.., end] = frames(joints);
    end
}

/// Joint positions [rad] near `start` that bring the end to `goal`, by damped least squares; `None` when that does not
/// lead there. Knows no joint limits.
pub fn inverse(goal: &Isometry3<f64>, start: &[f64; DOF]) -> Option<[f64; DOF]> {
    let mut joints = *start;
    for _ in 0..STEPS {
        let all = frames(&joints);
        let [.., end] = all;
        let turn = (goal.rotation * end.rotation.inverse()).scaled_axis();
        let way = goal.translation.vector - end.translation.vector;
        let error = Vector6::new(way.x, way.y, way.z, turn.x, turn.y, turn.z);
        if error.norm() < CLOSE {
            return Some(joints);
        }
        let mut jacobian = Matrix6::zeros();
        for (frame, mut column) in all.iter().zip(jacobian.column_iter_mut()) {
            let axis = frame.rotation * Vector3::z();
            let linear = axis.cross(&(end.translation.vector - frame.translation.vector));
            column.copy_from_slice(&[linear.x, linear.y, linear.z, axis.x, axis.y, axis.z]);
        }
        let square = jacobian * jacobian.transpose() + Matrix6::identity() * DAMPING;
        let step = jacobian.transpose() * square.cholesky()?.solve(&error);
        let scale = (0.3 / step.amax()).min(1.0);
        joints.iter_mut().zip(step.iter()).for_each(|(joint, d)| *joint += d * scale);
    }
    None
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

    /// Poses as the vendor's SDK computes them [mm, deg].
    #[test]
    fn poses_are_the_vendors() {
        for (joints, expected) in [
            ([0.0; 6], [56.1275, 0.0, 213.2663, 0.0, 85.0, 0.0]),
            ([0.1, 0.6, -0.7, 0.05, 0.4, -0.1], [119.1448, 13.7344, 363.413, -167.0061, 77.5146, -159.832]),
            ([-0.5, 1.2, -1.1, 0.7, -0.6, 1.0], [212.5119, -153.8147, 457.3204, 64.5483, -11.3688, 43.0656]),
        ] {
            let [x, y, z, roll, pitch, yaw] = to_values(&forward(&joints));
            let found = [x * 1e3, y * 1e3, z * 1e3, roll.to_degrees(), pitch.to_degrees(), yaw.to_degrees()];
            for (found, expected) in found.iter().zip(expected) {
                assert!((found - expected).abs() < 1e-3, "{joints:?}: {found} is not {expected}");
            }
        }
    }

    #[test]
    fn the_inverse_leads_back() {
        let (start, there) = ([0.1, 0.6, -0.7, 0.05, 0.4, -0.1], [0.3, 0.9, -0.9, 0.2, 0.6, -0.3]);
        let goal = from_values(to_values(&forward(&there)));
        let found = inverse(&goal, &start).unwrap();
        assert!((forward(&found).translation.vector - goal.translation.vector).norm() < 1e-5);
        assert_eq!(inverse(&from_values([2.0, 0.0, 0.0, 0.0, 0.0, 0.0]), &start), None);
    }
}
