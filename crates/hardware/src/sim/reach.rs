//! Poses of an emulated arm's end effector (x, y, z, roll, pitch, yaw), and inverse kinematics.

use nalgebra::{Isometry3, Matrix6, SMatrix, Vector3, Vector6};

/// Maximum number of iterations.
const STEPS: usize = 200;
/// Error at which the goal is reached [m and rad].
const TOLERANCE: f64 = 1e-6;
/// Damping of the least-squares step.
const DAMPING: f64 = 1e-4;
/// Maximum step of a joint [rad].
const MAX_STEP: f64 = 0.3;

/// A chain of revolute joints, from the base to the end effector.
pub trait Chain {
    /// Returns the transform from the frame before a joint (index from 0) to the joint's own frame [m], at a position
    /// [rad]; `None` after the last joint.
    fn link(&self, joint: usize, position: f64) -> Option<Isometry3<f64>>;

    /// Returns the axis of a joint in its own frame; by default z.
    fn axis(&self, _joint: usize) -> Vector3<f64> {
        Vector3::z()
    }

    /// Returns the end effector in the last joint's frame [m]; by default that frame.
    fn end(&self) -> Isometry3<f64> {
        Isometry3::identity()
    }

    /// Returns the end-effector pose in the base frame [m] for joint positions [rad].
    fn forward(&self, joints: &[f64]) -> Isometry3<f64> {
        let links = joints.iter().enumerate().map_while(|(joint, position)| self.link(joint, *position));
        links.fold(Isometry3::identity(), |pose, link| pose * link) * self.end()
    }

    /// Returns joint positions [rad] near `start` that bring the end effector to `goal`, by damped least squares;
    /// `None` if that does not converge. Ignores joint limits.
    fn inverse<const N: usize>(&self, goal: &Isometry3<f64>, start: &[f64; N]) -> Option<[f64; N]> {
        let mut joints = *start;
        for _ in 0..STEPS {
            let end = self.forward(&joints);
            let turn = (goal.rotation * end.rotation.inverse()).scaled_axis();
            let way = goal.translation.vector - end.translation.vector;
            let error = Vector6::new(way.x, way.y, way.z, turn.x, turn.y, turn.z);
            if error.norm() < TOLERANCE {
                return Some(joints);
            }
            let jacobian = self.jacobian(&joints, &end.translation.vector);
            let square = jacobian * jacobian.transpose() + Matrix6::identity() * DAMPING;
            let step = jacobian.transpose() * square.cholesky()?.solve(&error);
            let scale = (MAX_STEP / step.amax()).min(1.0);
            joints.iter_mut().zip(step.iter()).for_each(|(joint, d)| *joint += d * scale);
        }
        None
    }

    /// Returns the Jacobian of the end effector, which is at `end` [m]: m and rad per rad.
    fn jacobian<const N: usize>(&self, joints: &[f64; N], end: &Vector3<f64>) -> SMatrix<f64, 6, N> {
        let mut jacobian = SMatrix::<f64, 6, N>::zeros();
        let mut frame = Isometry3::identity();
        for ((joint, position), mut column) in joints.iter().enumerate().zip(jacobian.column_iter_mut()) {
            let Some(link) = self.link(joint, *position) else { break };
            frame *= link;
            let axis = frame.rotation * self.axis(joint);
            let linear = axis.cross(&(end - frame.translation.vector));
            column.copy_from_slice(&[linear.x, linear.y, linear.z, axis.x, axis.y, axis.z]);
        }
        jacobian
    }
}
