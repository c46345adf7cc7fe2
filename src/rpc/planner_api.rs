//! Parameters and replies of the planner's methods. Like motions, plans are numbered: `plan` replies when planning
//! begins, `planning` reports its progress.

use std::collections::BTreeMap;
use std::sync::{Arc, Weak};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::api::{MIN_SPEED, finite};
use super::motion_api::{DEFAULT_SPEED, Trajectory};

/// A pose in the frame `map`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PoseSpec {
    /// x, y, z [m].
    pub xyz: [f64; 3],
    /// Roll, pitch, yaw about fixed axes [rad].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rpy: Option<[f64; 3]>,
    /// A quaternion x, y, z, w, in place of `rpy`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub quat: Option<[f64; 4]>,
}

impl PoseSpec {
    pub(super) fn valid(&self, field: &str) -> Result<(), String> {
        finite(&format!("{field}.xyz"), &self.xyz)?;
        finite(&format!("{field}.rpy"), &self.rpy.unwrap_or_default())?;
        let quat = self.quat.unwrap_or([0.0, 0.0, 0.0, 1.0]);
        finite(&format!("{field}.quat"), &quat)?;
        let length = quat.iter().map(|v| v * v).sum::<f64>().sqrt();
        match (self.rpy, self.quat) {
            (Some(_), Some(_)) => Err(format!("{field} has both rpy and quat")),
            (_, Some(_)) if !(0.99..=1.01).contains(&length) => {
                Err(format!("{field}.quat has the length {length}, and must have 1"))
            }
            _ => Ok(()),
        }
    }
}

/// Goal of one robot: exactly one of `joints`, `pose`, `named`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PlanGoal {
    /// The robot's name in the planner.
    pub robot: String,
    /// Joint positions [rad], in the order of the robot's `joint_names`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub joints: Option<Vec<f64>>,
    /// Target pose of its end effector; without `rpy` and `quat` only the position counts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pose: Option<PoseSpec>,
    /// One of its named poses.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub named: Option<String>,
    /// Whether the end effector goes to `pose` on a straight line.
    #[serde(default)]
    pub linear: bool,
}

/// Parameters of `plan`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Plan {
    /// Goals of the robots, one entry each. The others stay where they are.
    pub goals: Vec<PlanGoal>,
    /// Fraction of the velocity and acceleration limits to use, 0.1–1.
    #[serde(default = "default_speed")]
    pub speed: f64,
    /// Seed of the search; the same request from the same state with the same seed gives the same plan.
    #[serde(default)]
    pub seed: u64,
    /// The longest time to search [s]; default: the blueprint's `planning_timeout`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub timeout: Option<f64>,
}

fn default_speed() -> f64 {
    DEFAULT_SPEED
}

impl Plan {
    pub(super) fn valid(&self) -> Result<(), String> {
        if self.goals.is_empty() {
            return Err("goals is empty".into());
        }
        for (index, goal) in self.goals.iter().enumerate() {
            let field = format!("goals[{index}]");
            if self.goals.iter().take(index).any(|other| other.robot == goal.robot) {
                return Err(format!("{field}: {} has a goal already", goal.robot));
            }
            let given = [goal.joints.is_some(), goal.pose.is_some(), goal.named.is_some()];
            if given.iter().filter(|given| **given).count() != 1 {
                return Err(format!("{field} must have one of joints, pose, named"));
            }
            if goal.linear && goal.pose.is_none() {
                return Err(format!("{field}: linear needs a pose"));
            }
            finite(&format!("{field}.joints"), goal.joints.as_deref().unwrap_or_default())?;
            goal.pose.map_or(Ok(()), |pose| pose.valid(&format!("{field}.pose")))?;
        }
        if !(MIN_SPEED..=1.0).contains(&self.speed) {
            return Err(format!("speed is {}, and must be within {MIN_SPEED}–1", self.speed));
        }
        match self.timeout {
            Some(timeout) if !(timeout > 0.0 && timeout <= 3600.0) => {
                Err(format!("timeout is {timeout}, and must be above 0 and at most 3600 s"))
            }
            _ => Ok(()),
        }
    }
}

/// Planning that began.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct PlanReply {
    /// The plan's number, for `planning`, `preview` and `execute_plan`.
    pub plan: u64,
}

/// Parameters of `planning`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Planning {
    /// The plan's number.
    pub plan: u64,
}

/// How planning goes, or what came of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct PlanningReport {
    /// The plan's number.
    pub plan: u64,
    /// `PLANNING`, `PLANNED`, `FAILED`, `CANCELLED`.
    pub state: String,
    /// How long it has taken so far, or took [s].
    pub elapsed: f64,
    /// Why there is no plan, in a sentence.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
    /// What to do about that.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hint: Option<String>,
    /// The plan.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub summary: Option<PlanSummary>,
}

/// A plan in figures.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct PlanSummary {
    /// The coordinator's joints that it moves.
    pub joints: Vec<String>,
    /// Where it starts [rad].
    pub start: Vec<f64>,
    /// Where it ends [rad].
    pub goal: Vec<f64>,
    /// Corners of the path, its ends included.
    pub waypoints: usize,
    /// Length of the path in joint space [rad].
    pub length: f64,
    /// How long the motion takes [s].
    pub duration: f64,
    /// Smallest distance to an obstacle or between links that are checked [m], where there is anything to be near to.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clearance: Option<f64>,
    /// The two that come closest.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub closest: Option<[String; 2]>,
    /// Distance that it keeps from obstacles and other arms [m].
    #[serde(default)]
    pub padding: f64,
    /// Pairs that do not keep it, and where.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub padding_given_up: Vec<PaddingGivenUp>,
    /// Of a straight line, the part that can be done (0–1].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fraction: Option<f64>,
    /// Seed of the search.
    pub seed: u64,
    /// Time for inverse kinematics, search, shortcuts, timing, checking [s].
    pub times: BTreeMap<String, f64>,
}

/// A pair that does not keep the padding, near the start or the goal, where it is closer itself.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct PaddingGivenUp {
    /// `start`, `goal`, or `everywhere`: the two are closer in every configuration.
    pub near: String,
    /// The link.
    pub link: String,
    /// The obstacle, or the link of another arm.
    pub other: String,
    /// Their distance there [m]; negative: they touch.
    pub distance: f64,
}

/// Parameters of `preview`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Preview {
    /// The plan's number; without it the newest plan.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plan: Option<u64>,
}

/// A plan in full.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct PreviewReply {
    /// The plan's number.
    pub plan: u64,
    /// The plan in figures.
    pub summary: PlanSummary,
    /// The motion, with the coordinator's joint names.
    pub trajectory: Trajectory,
    /// For each robot, where its end effector is at each point of the trajectory: x, y, z [m] in the frame `map`.
    pub end_effectors: BTreeMap<String, Vec<[f64; 3]>>,
}

/// Parameters of `execute_plan`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ExecutePlan {
    /// The plan's number; without it the newest plan.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plan: Option<u64>,
    /// Whether a motion that must end before something that gets in its way is planned again from there and continues.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub replan: bool,
    /// The connection that asks for it, where there is one: with its end nothing is planned again.
    #[serde(skip)]
    pub presence: Option<Presence>,
}

/// Whether a connection is still open.
#[derive(Debug, Clone)]
pub struct Presence(Weak<()>);

impl Presence {
    /// That of a connection which keeps `alive` to its end.
    pub fn of(alive: &Arc<()>) -> Self {
        Self(Arc::downgrade(alive))
    }

    /// Whether the connection has ended.
    pub fn is_over(&self) -> bool {
        self.0.strong_count() == 0
    }
}

impl PartialEq for Presence {
    fn eq(&self, other: &Self) -> bool {
        self.0.ptr_eq(&other.0)
    }
}

impl Eq for Presence {}

/// Parameters of `planner`: none.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Planner {}

/// What the planner is and does.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct PlannerReport {
    /// `IDLE`, `PLANNING`, `EXECUTING`, `COMPLETED`, `FAULT`.
    pub state: String,
    /// Why it is in `FAULT`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
    /// The robots that are planned for.
    pub robots: Vec<RobotReport>,
    /// Number of the newest plan.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plan: Option<u64>,
    /// Link pairs that touch in every configuration and are therefore not checked, by robot.
    pub always_touching: BTreeMap<String, Vec<[String; 2]>>,
}

/// A robot that is planned for.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct RobotReport {
    /// Its name.
    pub name: String,
    /// The link that pose goals are for.
    pub end_effector_link: String,
    /// The coordinator's joints, in the order of joint goals.
    pub joints: Vec<String>,
    /// Lowest and highest positions [rad]; `null` where a joint turns without end.
    pub limits: Vec<[Option<f64>; 2]>,
    /// The task that executes its motions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub task: Option<String>,
    /// Its named poses [rad].
    pub named_poses: BTreeMap<String, Vec<f64>>,
}
