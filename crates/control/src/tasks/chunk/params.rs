//! Parameters of a chunk task.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use dimos_yaml::range::non_negative;

/// Parameters of a `chunk` task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ChunkParams {
    /// After the end of the last chunk the joints decelerate; without a new one for this long the task lets go of them
    /// [s].
    #[serde(deserialize_with = "non_negative")]
    #[schemars(range(min = 0.0))]
    pub timeout: f64,
}

impl Default for ChunkParams {
    fn default() -> Self {
        Self { timeout: 0.5 }
    }
}
