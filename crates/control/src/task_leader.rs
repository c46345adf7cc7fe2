//! The leader of a task that follows another arm: its parameters in the blueprint, and its joints for the tick.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use serde::{Deserialize, Serialize};

use dimos_core::arm::{GripperInfo, GripperUnit};

/// The parameters that name a task's leader, read from among all its parameters. A type that has a key `leader` has the
/// others, too.
#[derive(Debug, Clone, PartialEq, Default, Deserialize)]
#[serde(default)]
pub struct LeaderParams {
    /// The `hardware_id` of the arm that leads.
    pub leader: Option<String>,
    /// The leader's joint for each joint of the task; empty: in order.
    pub joint_map: BTreeMap<String, String>,
    /// Factor on the leader's position, per joint of the task.
    pub scale: BTreeMap<String, f64>,
    /// What is added to it, per joint of the task [rad].
    pub offset: BTreeMap<String, f64>,
    /// Whether the gripper follows the leader's.
    pub gripper: bool,
}

/// The joint that a joint of a task follows, at `scale` · position + `offset`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LeaderJoint {
    /// Index over all arms' joints.
    pub joint: u16,
    /// Factor on its position.
    pub scale: f64,
    /// What is added [rad].
    pub offset: f64,
    /// Whether the joint that follows turns without end: angles that differ by whole turns are one place.
    #[serde(default)]
    pub endless: bool,
}

impl LeaderJoint {
    /// Returns the target of the joint that follows, for a position of the leader's [rad].
    pub fn target(&self, position: f64) -> f64 {
        self.scale * position + self.offset
    }

    /// Returns the same for a joint that is at `own` [rad]: where that turns without end, the way round the circle that
    /// is shorter. A joint with a range is never a turn nearer than its numbers say.
    pub fn target_near(&self, position: f64, own: f64) -> f64 {
        let target = self.target(position);
        let turns = if self.endless { ((own - target) / TAU).round() } else { 0.0 };
        target + turns * TAU
    }
}

/// A gripper is commanded again when its target has changed by this share of its range.
const GRIPPER_STEP: f64 = 0.01;
/// Share of a leader's range up to which a gripper that only opens and closes closes, and from which it opens.
const CLOSES: f64 = 0.4;
const OPENS: f64 = 0.6;

/// Returns the position to which a gripper follows that of its leader: the same share of its range, or the same
/// position where a range is not known. `None`: it is there already (`last` was commanded), or the units differ.
pub fn gripper_target(position: f64, of: &GripperInfo, own: &GripperInfo, last: Option<f64>) -> Option<f64> {
    let span = |range: (f64, f64)| range.1 - range.0;
    let unit = own.unit;
    let ranges = of.range.zip(own.range).filter(|(of, own)| span(*of) != 0.0 && span(*own) != 0.0);
    let (target, step) = match ranges {
        Some((of, own)) => {
            let mut share = ((position - of.0) / span(of)).clamp(0.0, 1.0);
            // In the middle of a leader's way one that only opens and closes stays as it is.
            if unit == GripperUnit::OnOff {
                share = match share {
                    ..=CLOSES => 0.0,
                    OPENS.. => 1.0,
                    _ => return None,
                };
            }
            (own.0 + share * span(own), GRIPPER_STEP * span(own).abs())
        }
        None if of.unit == own.unit => (position, 1e-3),
        None => return None,
    };
    let moves = last.is_none_or(|last| (target - last).abs() >= step);
    (target.is_finite() && moves).then_some(target)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_joint_without_end_takes_the_shorter_way_round() {
        let seamed = LeaderJoint { joint: 0, scale: 1.0, offset: 0.0, endless: false };
        assert_eq!(seamed.target_near(-3.1, 3.1), -3.1);
        let endless = LeaderJoint { endless: true, ..seamed };
        assert!((endless.target_near(-3.1, 3.1) - (TAU - 3.1)).abs() < 1e-12);
        assert!((endless.target_near(0.2, 2.0 * TAU) - (2.0 * TAU + 0.2)).abs() < 1e-12);
    }

    #[test]
    fn a_gripper_goes_to_the_same_share_of_its_own_range() {
        let jaw = GripperInfo { unit: GripperUnit::Radians, range: Some((0.0, 1.9)), ..Default::default() };
        let fingers = GripperInfo { range: Some((0.0, 0.08)), ..Default::default() };
        assert!((gripper_target(0.95, &jaw, &fingers, None).unwrap() - 0.04).abs() < 1e-12);
        assert_eq!(gripper_target(2.5, &jaw, &fingers, None), Some(0.08));
        assert_eq!(gripper_target(0.95, &jaw, &fingers, Some(0.0405)), None, "less than a step");
        let valve = GripperInfo { unit: GripperUnit::OnOff, range: Some((0.0, 1.0)), ..Default::default() };
        let switched = [0.0, 0.7, 0.9, 1.0, 1.2, 1.9].map(|angle| gripper_target(angle, &jaw, &valve, None));
        assert_eq!(switched, [Some(0.0), Some(0.0), None, None, Some(1.0), Some(1.0)], "it only opens and closes");
        let unknown = GripperInfo::default();
        assert_eq!(gripper_target(0.03, &fingers, &unknown, None), Some(0.03));
        assert_eq!(gripper_target(0.95, &jaw, &unknown, None), None, "an angle is no opening");
    }
}
