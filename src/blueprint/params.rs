//! What the task types can be told: `params` of a task.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::blueprint::range::{non_negative, positive};
use crate::yaml::Text;

/// Parameters of a `trajectory` task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct TrajectoryParams {
    /// How far each joint may be from the first point of a trajectory when it starts [rad].
    #[serde(deserialize_with = "non_negative")]
    #[schemars(range(min = 0.0))]
    pub start_position_tolerance: f64,
    /// How far a joint may stray from the trajectory on the way before it is aborted [rad]; 0 = not checked.
    #[serde(deserialize_with = "non_negative")]
    #[schemars(range(min = 0.0))]
    pub path_tolerance: f64,
    /// How near each joint must come to the last point to have arrived [rad].
    #[serde(deserialize_with = "positive")]
    #[schemars(extend("exclusiveMinimum" = 0.0))]
    pub goal_tolerance: f64,
    /// How long after the last point the joints may take to arrive [s].
    #[serde(deserialize_with = "non_negative")]
    #[schemars(range(min = 0.0))]
    pub goal_time: f64,
}

impl Default for TrajectoryParams {
    fn default() -> Self {
        Self { start_position_tolerance: 0.05, path_tolerance: 0.2, goal_tolerance: 0.01, goal_time: 2.0 }
    }
}

/// Parameters of a `servo` task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ServoParams {
    /// Without a new target for this long the task lets go of its joints [s]; 0 = never.
    #[serde(deserialize_with = "non_negative")]
    #[schemars(range(min = 0.0))]
    pub timeout: f64,
    /// Targets at the start, one for each joint of the task [rad].
    pub default_positions: Option<Vec<f64>>,
}

impl Default for ServoParams {
    fn default() -> Self {
        Self { timeout: 0.5, default_positions: None }
    }
}

/// Parameters of a `velocity` task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct VelocityParams {
    /// Without a new target for this long the joints are brought to rest [s]; 0 = never.
    #[serde(deserialize_with = "non_negative")]
    #[schemars(range(min = 0.0))]
    pub timeout: f64,
    /// After the timeout, keep commanding zero velocity (true) or let go of the joints (false).
    pub zero_on_timeout: bool,
}

impl Default for VelocityParams {
    fn default() -> Self {
        Self { timeout: 0.2, zero_on_timeout: true }
    }
}

/// Parameters of a `cartesian_ik` or `eef_twist` task. Where the planner has a robot with the task's joints, its
/// description, joint names and end effector are the default, and poses are in the frame `map`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct CartesianParams {
    /// The robot's `.urdf` or `.xacro` file, as seen from this file; or `builtin:NAME`, a description in the box. Poses
    /// and twists are then in the frame of its root link.
    pub model_path: Option<String>,
    /// Folders that `package://NAME` stands for, by name.
    pub package_paths: BTreeMap<String, String>,
    /// Arguments of the xacro file.
    pub xacro_args: BTreeMap<String, Text>,
    /// The link that is moved.
    pub end_effector_link: Option<String>,
    /// Shorthand for `joint_name_mapping`: the coordinator's joint `{joint_prefix}{joint}` is the model's `{joint}`.
    pub joint_prefix: Option<String>,
    /// The coordinator's joint names and the model's: `{arm_joint1: joint1}`. Default: they are the same.
    pub joint_name_mapping: BTreeMap<String, String>,
    /// Without a new target for this long the end effector comes to rest, and the task lets go of its joints [s];
    /// 0 = never.
    #[serde(deserialize_with = "non_negative")]
    #[schemars(range(min = 0.0))]
    pub timeout: f64,
    /// Highest speed of the end effector [m/s].
    #[serde(deserialize_with = "positive")]
    #[schemars(extend("exclusiveMinimum" = 0.0))]
    pub max_linear_velocity: f64,
    /// Highest angular speed of the end effector [rad/s].
    #[serde(deserialize_with = "positive")]
    #[schemars(extend("exclusiveMinimum" = 0.0))]
    pub max_angular_velocity: f64,
    /// Highest acceleration of the end effector [m/s²].
    #[serde(deserialize_with = "positive")]
    #[schemars(extend("exclusiveMinimum" = 0.0))]
    pub max_linear_acceleration: f64,
    /// Highest angular acceleration of the end effector [rad/s²].
    #[serde(deserialize_with = "positive")]
    #[schemars(extend("exclusiveMinimum" = 0.0))]
    pub max_angular_acceleration: f64,
    /// A joint that is measured further than this from where it is commanded to be ends the motion: the arm holds [rad].
    #[serde(deserialize_with = "positive")]
    #[schemars(extend("exclusiveMinimum" = 0.0))]
    pub max_tracking_error: f64,
}

impl Default for CartesianParams {
    fn default() -> Self {
        Self {
            model_path: None,
            package_paths: BTreeMap::new(),
            xacro_args: BTreeMap::new(),
            end_effector_link: None,
            joint_prefix: None,
            joint_name_mapping: BTreeMap::new(),
            timeout: 0.3,
            max_linear_velocity: 0.25,
            max_angular_velocity: 1.0,
            max_linear_acceleration: 1.0,
            max_angular_acceleration: 4.0,
            max_tracking_error: 0.1745,
        }
    }
}
