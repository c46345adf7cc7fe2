//! Parameters of a follow task.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::de::{Deserializer, Error};
use serde::{Deserialize, Serialize};

use dimos_yaml::range::{non_negative, positive};

/// Highest speed of a joint on its way to the leader [rad/s].
pub const MAX_APPROACH_SPEED: f64 = 0.3;

/// Furthest that a joint approaches its leader where the blueprint says nothing: half a turn [rad].
const MAX_APPROACH: f64 = std::f64::consts::PI;

/// Parameters of a `follow` task. The target of a joint is `scale` · the leader's joint + `offset`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct FollowParams {
    /// The arm that leads, by `hardware_id`; required. Its motors may be off.
    pub leader: Option<String>,
    /// The leader's joint for each joint of the task: `{follower_joint1: leader_joint1}`. Default: in order, if the
    /// leader has as many joints as the task.
    pub joint_map: BTreeMap<String, String>,
    /// Factor on the leader's position, for joints of the task: `{follower_joint2: -1}`; otherwise 1.
    pub scale: BTreeMap<String, f64>,
    /// What is added to the leader's position, for joints of the task [rad]; otherwise 0.
    pub offset: BTreeMap<String, f64>,
    /// Whether the gripper follows the leader's while the arm is in step: to the same share of its own range, at most
    /// 20 times per second.
    pub gripper: bool,
    /// Highest speed of a joint on its way to the leader, above 0 to 0.3 [rad/s].
    #[serde(deserialize_with = "approach_speed")]
    #[schemars(extend("exclusiveMinimum" = 0.0, "maximum" = MAX_APPROACH_SPEED))]
    pub approach_speed: f64,
    /// A joint that is further than this from the leader's is not moved to it: the task refuses to start, or ends
    /// [rad], above 0. Half a turn, unless a larger value is written here: a leader whose encoder lost a turn would
    /// take the arm with it.
    #[serde(deserialize_with = "positive")]
    #[schemars(extend("exclusiveMinimum" = 0.0))]
    pub max_approach: f64,
    /// Without a recent state of the leader the arm decelerates to rest. After this long the task ends [s]; before, the
    /// arm approaches the leader again.
    #[serde(deserialize_with = "non_negative")]
    #[schemars(range(min = 0.0))]
    pub leader_timeout: f64,
}

fn approach_speed<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    let value = f64::deserialize(d)?;
    if value > 0.0 && value <= MAX_APPROACH_SPEED {
        return Ok(value);
    }
    let hint = format!("hint: give a speed above 0 to {MAX_APPROACH_SPEED} rad/s");
    Err(D::Error::custom(format!("{value} is out of range\n{hint}")))
}

impl Default for FollowParams {
    fn default() -> Self {
        Self {
            leader: None,
            joint_map: BTreeMap::new(),
            scale: BTreeMap::new(),
            offset: BTreeMap::new(),
            gripper: false,
            approach_speed: MAX_APPROACH_SPEED,
            max_approach: MAX_APPROACH,
            leader_timeout: 2.0,
        }
    }
}
