//! Parameters and replies of the methods for the robots' models: their description, and where their links are.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters of `robot_description`: none.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RobotDescription {}

/// Reply to `robot_description`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct DescriptionReport {
    /// All robots in one URDF below the link `map`, with the joint names of the run; null without a model.
    pub urdf: Option<String>,
    /// The transforms that do not change.
    pub fixed: Vec<TransformReport>,
}

/// Parameters of `transforms`: none.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Transforms {}

/// Reply to `transforms`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct TransformsReport {
    /// Time of the joint states [s since 1970].
    pub stamp: f64,
    /// The transforms of joints that move and of tool centre points; none of a robot with an unknown joint.
    pub transforms: Vec<TransformReport>,
}

/// The pose of a frame in its parent.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct TransformReport {
    /// The parent frame.
    pub parent: String,
    /// The frame.
    pub child: String,
    /// Position [m].
    pub xyz: [f64; 3],
    /// Rotation: x, y, z, w.
    pub quat: [f64; 4],
}
