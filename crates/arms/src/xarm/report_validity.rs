//! Detects reports without measurements. A controller that has not read its encoders yet reports zeros, but zeros are
//! also the usual zero pose of these arms. The pose of the tool, which the controller computes from the joints,
//! separates the two.

use super::model::Model;
use super::protocol::report::Motion;
use dimos_core::arm::{ControllerPose, Pose};

/// How far a calibrated arm's flange may be from where the data sheet puts it [m].
const TOLERANCE: f64 = 0.02;
/// Millimetres per metre.
pub const MM_PER_M: f64 = 1000.0;

/// Returns a pose of the wire: x, y, z [mm], roll, pitch, yaw [rad].
pub fn pose(&[x, y, z, roll, pitch, yaw]: &[f64; 6]) -> Pose {
    Pose { xyz: [x, y, z].map(|v| v / MM_PER_M), rpy: [roll, pitch, yaw] }
}

/// The report's own sign that its positions are measured. `stated`: the pose in it, with the offsets of tool and base.
pub fn measured(motion: &Motion, model: Model, stated: &ControllerPose) -> Option<bool> {
    let pose = motion.pose.iter().any(|value| *value != 0.0);
    let joints = motion.position.iter().any(|value| *value != 0.0);
    match (joints, pose) {
        (true, true) => Some(true),
        (true, false) => None,
        (false, false) => Some(false),
        // Elsewhere with all joints at zero: the joints are not measured.
        (false, true) => at_zero(model, stated).then_some(true),
    }
}

/// Whether the flange is where it is with all joints at zero.
fn at_zero(model: Model, stated: &ControllerPose) -> bool {
    let (Some(Pose { xyz: [x, y, z], .. }), (forward, up)) = (stated.flange(), model.zero_pose()) else { return false };
    [x - forward / MM_PER_M, y, z - up / MM_PER_M].iter().all(|off| off.abs() < TOLERANCE)
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;

    #[test]
    fn zeros_are_measured_where_the_flange_agrees() {
        let report = |position: f64, wire: [f64; 6], base: Option<[f64; 6]>| {
            let motion = Motion { position: [position; 7], pose: wire, ..Motion::default() };
            let tool = Some(pose(&[10.0, 20.0, 172.0, 0.0, 0.0, 0.0]));
            measured(
                &motion,
                Model::Xarm6,
                &ControllerPose { tcp: pose(&wire), tool, base: base.map(|base| pose(&base)) },
            )
        };
        let zero = Some([0.0; 6]);
        let gripper = [217.0, -20.0, -60.0, PI, 0.0, 0.0];
        assert_eq!(report(0.0, [0.0; 6], zero), Some(false), "nothing is measured yet");
        assert_eq!(report(0.0, gripper, zero), Some(true), "the zero pose, with a gripper");
        assert_eq!(report(0.0, [400.0, 0.0, 300.0, PI, 0.0, 0.0], zero), None);
        let moved = [1217.0, -20.0, -60.0, PI, 0.0, 0.0];
        assert_eq!(
            report(0.0, moved, Some([1000.0, 0.0, 0.0, 0.0, 0.0, 0.0])),
            Some(true),
            "with an offset of the base"
        );
        assert_eq!(report(0.0, gripper, None), None, "the offset of the base is not known");
        assert_eq!(report(0.1, [400.0, 0.0, 300.0, 0.0, 0.0, 0.0], zero), Some(true));
        assert_eq!(report(0.1, [0.0; 6], zero), None);
    }
}
