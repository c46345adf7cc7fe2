//! Tasks in `status`, and the reply to `motion`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::api::SpeedReport;
use dimos_core::telemetry::Who;

/// One task in `status`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct TaskReport {
    /// Its name.
    pub name: String,
    /// Its type, as in the blueprint.
    #[serde(rename = "type")]
    pub kind: String,
    /// The methods that send it targets: `execute`, `servo`, `velocity`, `pose`, `twist`; `start`: it takes none.
    #[serde(default)]
    pub takes: Vec<String>,
    /// Joints that it may claim.
    pub joints: Vec<String>,
    /// Its priority; the highest wins.
    pub priority: i32,
    /// Its state: `IDLE`, `EXECUTING`, …
    pub state: String,
    /// Progress 0–1, if the task has an end.
    pub progress: Option<f64>,
    /// Reason for its state, if any.
    pub reason: Option<String>,
    /// Number of its current or latest motion.
    pub motion: Option<u64>,
    /// What currently limits its motion: the first joint whose commands are limited, a singularity, …
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bound: Option<String>,
    /// Largest distance of a joint from its leader's, while a `follow` task is active [rad].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub distance: Option<f64>,
    /// What was sent to a `chunk` task, and the gripper targets sent to any task; absent before the first.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stream: Option<StreamCounts>,
}

/// Counts of a task's chunks and gripper targets since the start of the run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct StreamCounts {
    /// Actions of chunks.
    pub actions: u64,
    /// Those that were dropped because their time was over.
    pub late_actions: u64,
    /// Gripper targets.
    pub gripper_targets: u64,
    /// Those that were dropped because their time was over.
    pub late_gripper_targets: u64,
}

impl TaskReport {
    /// Returns whether this method sends it targets.
    pub fn takes(&self, method: &str) -> bool {
        self.takes.iter().any(|taken| taken == method)
    }
}

/// Reply to `motion`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct MotionReport {
    /// The motion's number.
    pub motion: u64,
    /// The task that executes it.
    pub task: String,
    /// Who asked for it; absent: the run itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub by: Option<Who>,
    /// The task's state in this motion: `EXECUTING`, `COMPLETED`, `ABORTED`, …
    pub state: String,
    /// Whether it has ended and the arm is at rest.
    pub done: bool,
    /// Progress 0–1.
    pub progress: f64,
    /// Time since its start [s].
    pub elapsed: f64,
    /// Time until its planned end [s], with the present speed override and fraction; of its whole speed while paused.
    pub remaining: f64,
    /// The speed override, if it slows the motion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub speed: Option<SpeedReport>,
    /// Fraction of its speed at which the controller of an arm runs it, if that slows the motion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub speed_fraction: Option<f64>,
    /// Why it did not reach its goal; also if a condition has ended it that was awaited (`COMPLETED`).
    pub error: Option<String>,
    /// Whether an obstacle blocked it and it is being replanned; meanwhile it is not done.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub replanning: bool,
    /// Number of the motion that continues it around the obstacle.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<u64>,
    /// Whether it executes a plan: a direct motion and a trajectory of a client are not collision-checked.
    #[serde(default)]
    pub collision_checked: bool,
    /// If it retraces the log: time in it of the goal [s since 1970].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub retraces_to: Option<f64>,
    /// When done: final error of each joint.
    pub deviation: Option<Vec<Deviation>>,
}

/// Final error of a joint.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Deviation {
    /// The joint.
    pub joint: String,
    /// Target position [rad].
    pub target: f64,
    /// Measured position [rad].
    pub actual: f64,
}

impl Deviation {
    /// Returns measured minus target position [rad].
    pub fn error(&self) -> f64 {
        self.actual - self.target
    }
}
