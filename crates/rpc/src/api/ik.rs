//! Parameters and reply of `ik`: joint positions of a pose.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::api::finite;
use crate::api::planner::PoseSpec;

/// Parameters of `ik`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Ik {
    /// The robot's name in the planner.
    pub robot: String,
    /// Pose of its tool centre point in `map`; without `rpy` and `quat` the orientation is free.
    pub pose: PoseSpec,
    /// Joint positions to begin from [rad]; default: the present ones.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub near: Option<Vec<f64>>,
}

impl Ik {
    pub(crate) fn valid(&self) -> Result<(), String> {
        finite("near", self.near.as_deref().unwrap_or_default())?;
        self.pose.valid("pose")
    }
}

/// Reply to `ik`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct IkReply {
    /// Joint positions that reach the pose [rad]; absent if none were found.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub joints: Option<Vec<f64>>,
    /// What touches there, or why there are none; absent if the pose is free.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
}
