//! Parameters of the tasks that move an end effector.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use dimos_yaml::Text;
use dimos_yaml::range::{non_negative, positive};

/// Parameters of a `cartesian_ik` or `eef_twist` task. Where the planner has a robot with the task's joints, its
/// description, joint names and end effector are the default, and poses are in the frame `map`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct CartesianParams {
    /// The robot's `.urdf` or `.xacro` file, as seen from this file; or `builtin:NAME`, a built-in description. Poses
    /// and twists are then in the frame of its root link.
    pub model_path: Option<String>,
    /// Folders of `package://NAME`, by name.
    pub package_paths: BTreeMap<String, String>,
    /// Arguments of the xacro file.
    pub xacro_args: BTreeMap<String, Text>,
    /// The link that is moved.
    pub end_effector_link: Option<String>,
    /// Shorthand for `joint_name_mapping`: the coordinator's joint `{joint_prefix}{joint}` is the model's `{joint}`.
    pub joint_prefix: Option<String>,
    /// The coordinator's joint names and the model's: `{arm_joint1: joint1}`. Default: they are the same.
    pub joint_name_mapping: BTreeMap<String, String>,
    /// Positions of joints of the model that the task does not move: `{yaw: 0.3}` [rad or m].
    pub fixed_joints: BTreeMap<String, f64>,
    /// Without a new target for this long the end effector decelerates to rest, and the task releases its joints [s];
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
    /// A joint that is measured further than this from where it is commanded to be ends the motion: the arm holds
    /// [rad].
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
            fixed_joints: BTreeMap::new(),
            timeout: 0.3,
            max_linear_velocity: 0.25,
            max_angular_velocity: 1.0,
            max_linear_acceleration: 1.0,
            max_angular_acceleration: 4.0,
            max_tracking_error: 0.1745,
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::task_robot::RobotParams;

    #[test]
    fn the_robot_is_read_from_these_parameters() {
        let typed = json!({
            "model_path": "a.urdf", "package_paths": {"p": "q"}, "xacro_args": {"x": "0.50"},
            "end_effector_link": "flange", "joint_prefix": "arm_", "joint_name_mapping": {"a": "b"},
            "fixed_joints": {"yaw": 0.5}
        });
        let params = serde_json::to_value(CartesianParams::deserialize(&typed).unwrap()).unwrap();
        let robot = RobotParams::deserialize(&params).unwrap();
        let one = |key: &str, value: &str| BTreeMap::from([(key.to_owned(), value.to_owned())]);
        let expected = RobotParams {
            model_path: Some("a.urdf".into()),
            package_paths: one("p", "q"),
            xacro_args: BTreeMap::from([("x".into(), Text("0.50".into()))]),
            end_effector_link: Some("flange".into()),
            joint_prefix: Some("arm_".into()),
            joint_name_mapping: one("a", "b"),
            fixed_joints: BTreeMap::from([("yaw".into(), 0.5)]),
        };
        assert_eq!(robot, expected);
    }
}
