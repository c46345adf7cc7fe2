//! Parameters and replies of the methods that move arms.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::api::{MIN_SPEED, finite};
use dimos_core::joint::MAX_DOF;
use dimos_core::trajectory::{MAX_ACTIONS, MAX_DURATION};

/// A path in joint space, such as that of a motion that was led by hand or recorded, without its times.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct JointPath {
    /// Joint positions [rad], one value per joint; joined by straight lines. At most 5000.
    pub points: Vec<Vec<f64>>,
    /// How far the motion may pass from them, so that it need not stop at each, above 0 and at most 0.1 [rad].
    #[serde(default = "default_tolerance")]
    pub tolerance: f64,
}

/// Default tolerance of a path [rad].
pub const PATH_TOLERANCE: f64 = 0.005;
/// Maximum tolerance of a path [rad].
const MAX_TOLERANCE: f64 = 0.1;
/// Maximum number of points of a path.
pub const MAX_PATH: usize = 5000;

fn default_tolerance() -> f64 {
    PATH_TOLERANCE
}

impl JointPath {
    pub(crate) fn valid(&self) -> Result<(), String> {
        let (count, width) = (self.points.len(), self.points.first().map_or(0, Vec::len));
        if !(1..=MAX_PATH).contains(&count) {
            return Err(format!("path.points has {count} points, must have 1 to {MAX_PATH}"));
        }
        for (index, point) in self.points.iter().enumerate() {
            finite(&format!("path.points[{index}]"), point)?;
            if point.is_empty() || point.len() != width {
                return Err(format!("path.points[{index}] has {} values, the first point {width}", point.len()));
            }
        }
        match self.tolerance > 0.0 && self.tolerance <= MAX_TOLERANCE {
            true => Ok(()),
            false => {
                Err(format!("path.tolerance is {}, must be above 0 and at most {MAX_TOLERANCE} rad", self.tolerance))
            }
        }
    }
}

/// Parameters of `move`: exactly one of `target` and `path`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Move {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// Target of its joints [rad], one value per joint of the arm.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub target: Vec<f64>,
    /// Path that the joints follow, after a straight motion to its first point.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub path: Option<JointPath>,
    /// Fraction of the highest speed, 0.01–1: the same motion takes 1 / `speed` times as long.
    #[serde(default = "default_speed")]
    pub speed: f64,
    /// Velocity that no joint exceeds [rad/s], besides the limits; `speed` scales it too.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_velocity: Option<f64>,
    /// Acceleration that no joint exceeds [rad/s²], besides the limits; scaled by the square of `speed`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_acceleration: Option<f64>,
    /// Required if the run has a planner: the motion is not collision-checked. `plan` and `execute_plan` move around
    /// obstacles.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub direct: bool,
}

/// Parameters of `start`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Start {
    /// The task's name.
    pub task: String,
}

/// Default fraction of the highest speed for a motion.
pub const DEFAULT_SPEED: f64 = 0.5;

pub(crate) fn default_speed() -> f64 {
    DEFAULT_SPEED
}

/// Checks a fraction of the highest speed.
pub(crate) fn valid_speed(speed: f64) -> Result<(), String> {
    let valid = (MIN_SPEED..=1.0).contains(&speed);
    if valid { Ok(()) } else { Err(format!("speed is {speed}, must be within {MIN_SPEED}–1")) }
}

impl Move {
    /// Creates a request without further caps, for a run without a planner.
    pub fn new(arm: impl Into<String>, target: impl Into<Vec<f64>>, speed: f64) -> Self {
        let (arm, target) = (arm.into(), target.into());
        Self { arm, target, path: None, speed, max_velocity: None, max_acceleration: None, direct: false }
    }

    /// Creates a request for a motion that is not collision-checked, also in a run with a planner.
    pub fn direct(arm: impl Into<String>, target: impl Into<Vec<f64>>, speed: f64) -> Self {
        Self { direct: true, ..Self::new(arm, target, speed) }
    }

    pub(crate) fn valid(&self) -> Result<(), String> {
        let count = self.target.len();
        if let Some(path) = &self.path {
            path.valid()?;
            if count > 0 {
                return Err("target excludes path".into());
            }
        } else if !(1..=MAX_DOF).contains(&count) {
            return Err(format!("target has {count} values, must have 1 to {MAX_DOF}"));
        }
        finite("target", &self.target)?;
        for (field, cap) in [("max_velocity", self.max_velocity), ("max_acceleration", self.max_acceleration)] {
            if let Some(cap) = cap.filter(|cap| !(cap.is_finite() && *cap > 0.0)) {
                return Err(format!("{field} is {cap}, must be above 0"));
            }
        }
        valid_speed(self.speed)
    }
}

/// Reply to `move`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct MoveReply {
    /// The motion's number, for `motion`.
    pub motion: u64,
    /// The task that executes it.
    pub task: String,
    /// Planned duration [s].
    pub duration: f64,
    /// Names of the joints, in the order of the values.
    pub joints: Vec<String>,
    /// Start positions [rad].
    pub start: Vec<f64>,
    /// Target positions [rad].
    pub target: Vec<f64>,
    /// Whether the motion was checked for collisions: a direct one is not.
    #[serde(default)]
    pub collision_checked: bool,
}

/// Parameters of `execute`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Execute {
    /// The trajectory.
    pub trajectory: Trajectory,
    /// The trajectory task to use; default: the one whose joints cover the trajectory's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub task: Option<String>,
    /// If the motion retraces the log: time in it of the goal [s since 1970]. `motion` reports it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub retraces_to: Option<f64>,
}

/// A trajectory with the field names and meaning of ROS (`trajectory_msgs/JointTrajectory`).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Trajectory {
    /// The joints, in the order of every point's values.
    pub joint_names: Vec<String>,
    /// The points, in order of time.
    pub points: Vec<Point>,
}

/// A point of a trajectory.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Point {
    /// Time since the trajectory's start [s].
    pub time_from_start: f64,
    /// Joint positions [rad].
    pub positions: Vec<f64>,
    /// Joint velocities [rad/s]; if missing, the task chooses the path between the points.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub velocities: Option<Vec<f64>>,
    /// Joint accelerations [rad/s²].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub accelerations: Option<Vec<f64>>,
}

impl Execute {
    pub(crate) fn valid(&self) -> Result<(), String> {
        let joints = self.trajectory.joint_names.len();
        if joints == 0 {
            return Err("trajectory.joint_names is empty".into());
        }
        for (index, point) in self.trajectory.points.iter().enumerate() {
            let at = |field| format!("trajectory.points[{index}].{field}");
            finite(&at("time_from_start"), &[point.time_from_start])?;
            if point.time_from_start > MAX_DURATION {
                let (given, hours) = (point.time_from_start, MAX_DURATION / 3600.0);
                return Err(format!("{} is {given} s, must be at most {hours} h", at("time_from_start")));
            }
            let given = [
                ("positions", Some(&point.positions)),
                ("velocities", point.velocities.as_ref()),
                ("accelerations", point.accelerations.as_ref()),
            ];
            for (field, values) in given.into_iter().filter_map(|(field, v)| v.map(|v| (field, v))) {
                finite(&at(field), values)?;
                if values.len() != joints {
                    return Err(format!("{} has {} values for {joints} joints", at(field), values.len()));
                }
            }
        }
        Ok(())
    }
}

/// Reply to `execute` and `execute_plan`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ExecuteReply {
    /// The motion's number, for `motion`.
    pub motion: u64,
    /// The task that executes it.
    pub task: String,
    /// Duration of the trajectory [s].
    pub duration: f64,
}

/// Parameters of `motion`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Motion {
    /// The motion's number.
    pub motion: u64,
}

/// Parameters of `cancel`; without any, all motions end.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Cancel {
    /// Ends the motions that move this arm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub arm: Option<String>,
    /// Ends the motion of this task.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub task: Option<String>,
    /// Ends only the planning of the plan with this number, and no motion. Excludes `arm` and `task`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plan: Option<u64>,
    /// Ends what is being done for the `go` with this number, and nothing else. Excludes the others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub going: Option<u64>,
}

impl Cancel {
    pub(crate) fn valid(&self) -> Result<(), String> {
        if self.plan.is_some() && (self.arm.is_some() || self.task.is_some()) {
            return Err("plan excludes arm and task".into());
        }
        if self.going.is_some() && (self.plan.is_some() || self.arm.is_some() || self.task.is_some()) {
            return Err("going excludes arm, task and plan".into());
        }
        Ok(())
    }
}

/// Reply to `cancel`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct CancelReply {
    /// Result for each task: `CANCELLED` or `ALREADY_STOPPED`.
    pub tasks: BTreeMap<String, String>,
    /// Whether planning was cancelled.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub planning: bool,
}

/// Parameters of `speed`: what is absent stays as it is.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Speed {
    /// Fraction of the speed of all motions, 0.01–1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fraction: Option<f64>,
    /// Whether all motions are to pause on their paths.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub paused: Option<bool>,
}

impl Speed {
    pub(crate) fn valid(&self) -> Result<(), String> {
        match self.fraction.filter(|fraction| !(MIN_SPEED..=1.0).contains(fraction)) {
            Some(fraction) => Err(format!("fraction is {fraction}, must be within {MIN_SPEED}–1")),
            None => Ok(()),
        }
    }
}

/// The speed override of a run: reply to `speed`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SpeedReport {
    /// Fraction of the speed of all motions, 0.01–1.
    pub fraction: f64,
    /// Whether all motions are paused.
    pub paused: bool,
}

impl Default for SpeedReport {
    fn default() -> Self {
        Self { fraction: 1.0, paused: false }
    }
}

/// Parameters of `servo`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Servo {
    /// The servo task's name.
    pub task: String,
    /// Joint positions [rad], in the order of the task's joints.
    pub positions: Vec<f64>,
    /// Target of the gripper of the task's arm [`gripper_unit` in `status`]; commanded at most 20 times a second.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gripper: Option<f64>,
}

impl Servo {
    /// Creates a target without one for the gripper.
    pub fn new(task: impl Into<String>, positions: Vec<f64>) -> Self {
        Self { task: task.into(), positions, gripper: None }
    }

    pub(crate) fn valid(&self) -> Result<(), String> {
        finite("positions", &self.positions)?;
        finite("gripper", self.gripper.as_slice())
    }
}

/// Parameters of `velocity`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Velocity {
    /// The velocity task's name.
    pub task: String,
    /// Joint velocities [rad/s], in the order of the task's joints.
    pub velocities: Vec<f64>,
}

impl Velocity {
    pub(crate) fn valid(&self) -> Result<(), String> {
        finite("velocities", &self.velocities)
    }
}

/// Parameters of `chunk`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Chunk {
    /// The chunk task's name.
    pub task: String,
    /// Joint positions [rad], one row per action, in the order of the task's joints.
    pub actions: Vec<Vec<f64>>,
    /// Time between two actions [s].
    pub period: f64,
    /// Time of the first action, on the clock of `stamp` in `state` and in joint states [s since 1970]; default: now.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<f64>,
    /// Targets of the gripper of the task's arm [`gripper_unit` in `status`], one per action; commanded at their times,
    /// at most 20 times a second.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gripper: Option<Vec<f64>>,
}

/// Reply to `chunk`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct ChunkReply {
    /// Number of its actions.
    pub actions: usize,
    /// Number of those that were skipped because their time was over; with all of them, nothing has changed.
    pub late: usize,
}

impl Chunk {
    pub(crate) fn valid(&self) -> Result<(), String> {
        let (count, width) = (self.actions.len(), self.actions.first().map_or(0, Vec::len));
        if !(2..=MAX_ACTIONS).contains(&count) {
            return Err(format!("actions has {count} rows, must have 2 to {MAX_ACTIONS}"));
        }
        for (index, action) in self.actions.iter().enumerate() {
            finite(&format!("actions[{index}]"), action)?;
            if action.len() != width {
                return Err(format!("actions[{index}] has {} values, the first {width}", action.len()));
            }
        }
        if let Some(gripper) = &self.gripper {
            finite("gripper", gripper)?;
            if gripper.len() != count {
                return Err(format!("gripper has {} values for {count} actions", gripper.len()));
            }
        }
        if !(0.001..=1.0).contains(&self.period) {
            return Err(format!("period is {} s, must be within 0.001–1", self.period));
        }
        finite("start", &[self.start.unwrap_or_default()])
    }
}
