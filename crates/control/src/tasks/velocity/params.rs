//! Parameters of a velocity task.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use dimos_yaml::range::non_negative;

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
