//! The leader of a task that follows another arm: its parameters in the blueprint, and its joints for the tick.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

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
}

impl LeaderJoint {
    /// Returns the target of the joint that follows, for a position of the leader's [rad].
    pub fn target(&self, position: f64) -> f64 {
        self.scale * position + self.offset
    }
}
