//! Parameters of a trajectory task.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use dimos_yaml::range::{non_negative, positive};

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
