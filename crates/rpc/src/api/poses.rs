//! Parameters and replies of the methods for saved poses.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use dimos_core::joint::LONGEST_NAME;

/// A saved pose: joint positions [rad] by arm and joint.
pub type SavedPose = BTreeMap<String, BTreeMap<String, f64>>;

/// Parameters of `poses`: none.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Poses {}

/// Reply to `poses`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct PosesReport {
    /// The poses by name.
    pub poses: BTreeMap<String, SavedPose>,
    /// The file that has them.
    pub file: String,
}

/// Parameters of `pose_save`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PoseSave {
    /// Its name: letters, digits, `-`, `_` and `.`.
    pub name: String,
    /// The arms whose joints it has; without any, all of the run.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub arms: Vec<String>,
}

impl PoseSave {
    pub(crate) fn valid(&self) -> Result<(), String> {
        let plain = |c: char| c.is_alphanumeric() || "-_.".contains(c);
        match self.name {
            ref name if name.is_empty() || name.len() > LONGEST_NAME => {
                Err(format!("name has {} bytes, must have 1 to {LONGEST_NAME}", name.len()))
            }
            ref name if !name.chars().all(plain) => {
                Err(format!("name is {name:?}, must be of letters, digits, -, _ and ."))
            }
            _ => Ok(()),
        }
    }
}

/// Reply to `pose_save`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct PoseSaved {
    /// Its name.
    pub name: String,
    /// What was saved: the measured positions.
    pub pose: SavedPose,
    /// Whether it replaced one of the same name.
    pub replaced: bool,
}

/// Parameters of `pose_remove`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PoseRemove {
    /// Its name.
    pub name: String,
}
