//! Detects reports without measurements. A controller that has not read its encoders yet reports zeros, but zeros are
//! also the usual zero pose of these arms. The pose of the tool, which the controller computes from the joints,
//! separates the two.

use super::model::Model;
use super::protocol::report::Motion;

/// How far a calibrated arm's tool may be from where the data sheet puts it [mm].
const TOLERANCE: f64 = 20.0;

/// The report's own sign that its positions are measured. `tool`: where the tool is from the flange [mm].
pub fn measured(motion: &Motion, model: Model, tool: [f64; 3]) -> Option<bool> {
    let pose = motion.pose.iter().any(|value| *value != 0.0);
    let joints = motion.position.iter().any(|value| *value != 0.0);
    match (joints, pose) {
        (true, true) => Some(true),
        (true, false) => None,
        (false, false) => Some(false),
        // Elsewhere with all joints at zero: another base frame is set, or the joints are not measured.
        (false, true) => at_zero(motion, model, tool).then_some(true),
    }
}

/// Whether the tool is where it is with all joints at zero.
fn at_zero(motion: &Motion, model: Model, tool: [f64; 3]) -> bool {
    let ([x, y, z, ..], [right, left, out], (forward, up)) = (motion.pose, tool, model.zero_pose());
    let off = [x - forward - right, y + left, z - up + out];
    off.iter().all(|off| off.abs() < TOLERANCE)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zeros_are_measured_where_the_tool_agrees() {
        let report = |position: f64, pose: [f64; 3]| {
            let [x, y, z] = pose;
            let motion = Motion { position: [position; 7], pose: [x, y, z, 0.0, 0.0, 0.0], ..Motion::default() };
            measured(&motion, Model::Xarm6, [10.0, 20.0, 172.0])
        };
        assert_eq!(report(0.0, [0.0; 3]), Some(false), "nothing is measured yet");
        assert_eq!(report(0.0, [217.0, -20.0, -60.0]), Some(true), "the zero pose, with a gripper");
        assert_eq!(report(0.0, [400.0, 0.0, 300.0]), None);
        assert_eq!(report(0.1, [400.0, 0.0, 300.0]), Some(true));
        assert_eq!(report(0.1, [0.0; 3]), None);
    }
}
