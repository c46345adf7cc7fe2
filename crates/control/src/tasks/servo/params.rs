//! Parameters of a servo task.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use dimos_yaml::range::non_negative;

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
