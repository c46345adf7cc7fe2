//! Parameters of the methods that stream end-effector targets.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::api::finite;
use crate::api::planner::PoseSpec;

/// Parameters of `twist`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Twist {
    /// The `eef_twist` task's name.
    pub task: String,
    /// Linear velocity of the end effector's origin along x, y, z [m/s].
    pub linear: [f64; 3],
    /// Angular velocity of the end effector about x, y, z [rad/s].
    pub angular: [f64; 3],
    /// Frame whose axes x, y, z are.
    #[serde(default)]
    pub frame: TwistFrame,
}

/// Frame of a twist.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum TwistFrame {
    /// The robot's base.
    #[default]
    Base,
    /// The end effector.
    Tool,
}

impl Twist {
    pub(crate) fn valid(&self) -> Result<(), String> {
        finite("linear", &self.linear)?;
        finite("angular", &self.angular)
    }
}

/// Parameters of `pose`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Pose {
    /// The `cartesian_ik` task's name.
    pub task: String,
    /// Target position of the end effector: x, y, z [m].
    pub xyz: [f64; 3],
    /// Its roll, pitch, yaw about fixed axes [rad].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rpy: Option<[f64; 3]>,
    /// Its orientation as a quaternion x, y, z, w, instead of `rpy`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub quat: Option<[f64; 4]>,
}

impl Pose {
    /// Returns the target pose.
    pub fn spec(&self) -> PoseSpec {
        PoseSpec { xyz: self.xyz, rpy: self.rpy, quat: self.quat }
    }

    pub(crate) fn valid(&self) -> Result<(), String> {
        if self.rpy.is_none() && self.quat.is_none() {
            return Err("the orientation is missing: give rpy or quat".into());
        }
        self.spec().valid("target")
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::api::Request;

    #[test]
    fn invalid_targets_are_refused() {
        let refused = |method: &str, params: serde_json::Value| Request::read(method, params).unwrap_err().message;
        let pose = |more: serde_json::Value| {
            let mut params = json!({"task": "t", "xyz": [0.3, 0, 0.4]});
            params.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
            params
        };
        assert!(refused("pose", pose(json!({}))).contains("orientation"));
        assert!(refused("pose", pose(json!({"rpy": [0, 0, 0], "quat": [0, 0, 0, 1]}))).contains("both"));
        assert!(refused("pose", pose(json!({"quat": [0, 0, 0, 2]}))).contains("length"));
        assert!(refused("pose", pose(json!({"quat": [0, 0, 0, 0]}))).contains("length"));
        assert!(refused("pose", pose(json!({"rpy": [0, null, 0]}))).contains("null"));
        assert!(Request::read("pose", pose(json!({"quat": [0, 0, 0, 1]}))).is_ok());
        let twist = json!({"task": "t", "linear": [0.1, 0, 0], "angular": [0, 0, 0], "frame": "tool"});
        let Ok(Request::Twist(read)) = Request::read("twist", twist) else { panic!() };
        assert_eq!(read.frame, TwistFrame::Tool);
        let odd = json!({"task": "t", "linear": [0.1, 0, 0], "angular": [0, 0, 0], "frame": "world"});
        assert!(refused("twist", odd).contains("world"));
        let infinite = Twist { linear: [0.0, f64::INFINITY, 0.0], ..read };
        assert!(infinite.valid().unwrap_err().contains("inf"));
    }
}
