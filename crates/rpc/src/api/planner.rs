//! Parameters and replies of the planner's methods. Like motions, plans are numbered: `plan` replies when planning
//! begins, `planning` reports its progress.

use std::collections::BTreeMap;
use std::sync::{Arc, Weak};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::api::finite;
use crate::api::motion::{JointPath, Trajectory, default_speed, valid_speed};
use crate::report::{TcpReport, ToolReport};
use dimos_core::written;

/// A pose; in the frame `map` unless another is given with it.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PoseSpec {
    /// x, y, z [m].
    pub xyz: [f64; 3],
    /// Roll, pitch, yaw about fixed axes [rad].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rpy: Option<[f64; 3]>,
    /// The orientation as a quaternion x, y, z, w, instead of `rpy`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub quat: Option<[f64; 4]>,
}

impl PoseSpec {
    pub(crate) fn valid(&self, field: &str) -> Result<(), String> {
        finite(&format!("{field}.xyz"), &self.xyz)?;
        finite(&format!("{field}.rpy"), &self.rpy.unwrap_or_default())?;
        let length = |v: &f64| written::length(*v).map_err(|wrong| format!("{field}.xyz: {wrong}"));
        self.xyz.iter().try_for_each(length)?;
        let angle = |v: &f64| written::angle(*v).map_err(|wrong| format!("{field}.rpy: {wrong}"));
        self.rpy.iter().flatten().try_for_each(angle)?;
        let quat = self.quat.unwrap_or([0.0, 0.0, 0.0, 1.0]);
        finite(&format!("{field}.quat"), &quat)?;
        let length = quat.iter().map(|v| v * v).sum::<f64>().sqrt();
        match (self.rpy, self.quat) {
            (Some(_), Some(_)) => Err(format!("{field} has both rpy and quat")),
            (_, Some(_)) if !(0.99..=1.01).contains(&length) => {
                Err(format!("{field}.quat has length {length}, must be 1"))
            }
            _ => Ok(()),
        }
    }
}

/// Goal of one robot: exactly one of `joints`, `pose`, `by`, `named`, `path`, `retrace`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PlanGoal {
    /// The robot's name in the planner.
    pub robot: String,
    /// Joint positions [rad], in the order of the robot's `joint_names`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub joints: Option<Vec<f64>>,
    /// Target pose of its tool centre point; without `rpy` and `quat` the orientation is free.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pose: Option<PoseSpec>,
    /// Motion of its tool centre point from its present pose: `xyz` along the axes of `frame`, then the rotation about
    /// them; without `rpy` and `quat` it keeps its orientation.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub by: Option<PoseSpec>,
    /// Frame of `pose` or `by`: `map` (default), `base` (the robot's base link), `tool` (its tool centre point now), or
    /// an object of the world.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frame: Option<String>,
    /// One of its named poses.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub named: Option<String>,
    /// A path that it follows as it is, after a planned approach to its first point; for the only robot that moves.
    /// Refused where it is not free.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub path: Option<JointPath>,
    /// Joint positions [rad] to pass in this order, straight in joint space; the last are the goal. Nothing is
    /// searched: there is no plan if they are blocked. They keep half the padding, as the arm has been there.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub retrace: Option<Vec<Vec<f64>>>,
    /// Whether the tool centre point moves there on a straight line.
    #[serde(default)]
    pub linear: bool,
    /// Place [m] that its tool centre point passes on the way to `pose` or `by`, on the arc of a circle; as those,
    /// along the axes of `frame`, and with `by` from its present place.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub via: Option<[f64; 3]>,
}

/// Parameters of `plan`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Plan {
    /// Goals of the robots, at most one each. Robots without a goal do not move.
    pub goals: Vec<PlanGoal>,
    /// Fraction of the highest speed, 0.01–1: the same motion takes 1 / `speed` times as long.
    #[serde(default = "default_speed")]
    pub speed: f64,
    /// Seed of the search; the same request from the same state with the same seed gives the same plan.
    #[serde(default)]
    pub seed: u64,
    /// How motions are checked.
    #[serde(default, skip_serializing_if = "PlanLevel::is_default")]
    pub level: PlanLevel,
    /// Rounds of refinement: each looks for a shorter path. The same number gives the same plan, unless
    /// they end early: at half of the time until the timeout.
    #[serde(default = "default_refine", skip_serializing_if = "is_default_refine")]
    pub refine: u32,
    /// Maximum planning time [s]; default: the blueprint's `planning_timeout`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub timeout: Option<f64>,
    /// Waypoints that the motion passes before the goal, in order; for the robot of the only goal.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub through: Vec<PlanGoal>,
    /// How far away its tool centre point may pass them, 0–1 [m]; 0: it stops at each.
    #[serde(default)]
    pub blend: f64,
    /// Highest speed of tool centre points and flanges in this motion, above 0 and at most 10 [m/s], beside
    /// `limits.tcp_velocity`. Where no joint is slower the tool keeps it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tcp_speed: Option<f64>,
    /// Obstacles that the end effectors of its robots and what they hold may touch: for a motion that ends by a force.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub touch: Vec<String>,
    /// Whether only its number selects this plan: `execute_plan` and `preview` without a number pass it over. For a
    /// motion that is planned and executed in one step.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub by_number: bool,
}

impl Default for Plan {
    fn default() -> Self {
        let (goals, through, speed) = (Vec::new(), Vec::new(), default_speed());
        let level = PlanLevel::default();
        let (refine, timeout) = (DEFAULT_REFINE, None);
        let (blend, tcp_speed, touch) = (0.0, None, Vec::new());
        Self { goals, speed, seed: 0, level, refine, timeout, through, blend, tcp_speed, touch, by_number: false }
    }
}

/// Rounds of refinement of a request that does not say how many: they take about 0.3 ms, and motions around obstacles
/// become a tenth quicker.
pub const DEFAULT_REFINE: u32 = 4;

fn default_refine() -> u32 {
    DEFAULT_REFINE
}

fn is_default_refine(rounds: &u32) -> bool {
    *rounds == DEFAULT_REFINE
}

/// How the motions of a plan are checked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum PlanLevel {
    /// At samples, 32 per radian: quick, nothing is proven. Such a plan is executed only with `unproven`.
    Fast,
    /// Proven free of contact, between the samples too.
    #[default]
    Certified,
    /// The same, searched with proven motions only, and with the clearance to 0.5 mm.
    Exact,
}

impl PlanLevel {
    /// Returns its name in requests.
    pub fn name(self) -> &'static str {
        match self {
            Self::Fast => "fast",
            Self::Certified => "certified",
            Self::Exact => "exact",
        }
    }

    fn is_default(&self) -> bool {
        *self == Self::default()
    }
}

/// Most configurations of a path.
pub const MAX_RETRACE: usize = 2000;
/// Farthest that a waypoint may be passed [m].
const MAX_BLEND: f64 = 1.0;
/// Highest speed of a tool [m/s].
pub const MAX_TCP_SPEED: f64 = 10.0;

impl PlanGoal {
    fn valid(&self, field: &str) -> Result<(), String> {
        let retrace = self.retrace.as_deref().unwrap_or_default();
        let given = [
            self.joints.is_some(),
            self.pose.is_some(),
            self.by.is_some(),
            self.named.is_some(),
            self.path.is_some(),
            self.retrace.is_some(),
        ];
        if given.iter().filter(|given| **given).count() != 1 {
            return Err(format!("{field} must have one of joints, pose, by, named, path, retrace"));
        }
        self.path.as_ref().map_or(Ok(()), |path| path.valid().map_err(|what| format!("{field}.{what}")))?;
        if self.retrace.is_some() && !(1..=MAX_RETRACE).contains(&retrace.len()) {
            return Err(format!("{field}.retrace has {} configurations, must have 1 to {MAX_RETRACE}", retrace.len()));
        }
        retrace.iter().try_for_each(|q| finite(&format!("{field}.retrace"), q))?;
        let is_pose = self.pose.is_some() || self.by.is_some();
        if self.linear && !is_pose {
            return Err(format!("{field}: linear needs a pose"));
        }
        if self.via.is_some() && (self.linear || !is_pose) {
            return Err(format!("{field}: via needs a pose, and is not on a straight line: leave out linear"));
        }
        finite(&format!("{field}.via"), self.via.as_ref().map_or(&[], |via| via.as_slice()))?;
        if self.frame.is_some() && !is_pose {
            return Err(format!("{field}: frame needs a pose"));
        }
        finite(&format!("{field}.joints"), self.joints.as_deref().unwrap_or_default())?;
        self.pose.map_or(Ok(()), |pose| pose.valid(&format!("{field}.pose")))?;
        self.by.map_or(Ok(()), |by| by.valid(&format!("{field}.by")))
    }
}

impl Plan {
    pub(crate) fn valid(&self) -> Result<(), String> {
        if self.goals.is_empty() {
            return Err("goals is empty".into());
        }
        for (index, goal) in self.goals.iter().enumerate() {
            let field = format!("goals[{index}]");
            if self.goals.iter().take(index).any(|other| other.robot == goal.robot) {
                return Err(format!("{field}: {} has a goal already", goal.robot));
            }
            goal.valid(&field)?;
            if goal.path.is_some() && (self.goals.len() > 1 || !self.through.is_empty()) {
                return Err(format!("{field}: a path is followed by one robot alone, and without other waypoints"));
            }
        }
        for (index, waypoint) in self.through.iter().enumerate() {
            let field = format!("through[{index}]");
            waypoint.valid(&field)?;
            if self.goals.len() != 1 || self.goals.iter().any(|goal| goal.robot != waypoint.robot) {
                return Err(format!("{field}: waypoints are for the robot of the only goal"));
            }
            if waypoint.path.is_some() {
                return Err(format!("{field}: a path is no waypoint"));
            }
            let starts_here = |goal: &PlanGoal| goal.by.is_some() || goal.retrace.is_some();
            if starts_here(waypoint) || self.goals.iter().any(starts_here) {
                return Err(format!("{field}: `by` and `retrace` begin at the present pose, not at a waypoint"));
            }
        }
        if !(0.0..=MAX_BLEND).contains(&self.blend) {
            return Err(format!("blend is {} m, must be within 0–{MAX_BLEND}", self.blend));
        }
        valid_speed(self.speed)?;
        if let Some(speed) = self.tcp_speed.filter(|speed| !(*speed > 0.0 && *speed <= MAX_TCP_SPEED)) {
            return Err(format!("tcp_speed is {speed} m/s, must be above 0 and at most {MAX_TCP_SPEED} m/s"));
        }
        match self.timeout {
            Some(timeout) if !(timeout > 0.0 && timeout <= 3600.0) => {
                Err(format!("timeout is {timeout}, must be above 0 and at most 3600 s"))
            }
            _ => Ok(()),
        }
    }
}

/// Reply to `plan`.
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

/// Reply to `planning`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct PlanningReport {
    /// The plan's number.
    pub plan: u64,
    /// `PLANNING`, `PLANNED`, `FAILED`, `CANCELLED`.
    pub state: String,
    /// Planning time so far, or in total [s].
    pub elapsed: f64,
    /// Why there is no plan.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
    /// What to do about it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hint: Option<String>,
    /// Figures of the plan.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub summary: Option<PlanSummary>,
}

/// Figures of a plan.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct PlanSummary {
    /// The coordinator's joints that it moves.
    pub joints: Vec<String>,
    /// Start positions [rad].
    pub start: Vec<f64>,
    /// Goal positions [rad].
    pub goal: Vec<f64>,
    /// Number of waypoints of the path, including its ends.
    pub waypoints: usize,
    /// Length of the path in joint space [rad].
    pub length: f64,
    /// Duration of the motion [s].
    pub duration: f64,
    /// When it passes the waypoints of `through` [s].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub passes: Vec<f64>,
    /// How it was checked.
    #[serde(default)]
    pub level: PlanLevel,
    /// Distance to obstacles and between checked links that the whole motion is proven to keep, between samples too
    /// [m]; at most 0.2. It may be some millimetres more; with the level `exact`, 0.5 mm. Negative: the depth of a
    /// contact at the start. Missing if nothing can collide, or nothing is proven.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clearance: Option<f64>,
    /// The two bodies that are not proven to stay farther apart; missing if none are near.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub closest: Option<[String; 2]>,
    /// Required distance to obstacles and other arms [m].
    #[serde(default)]
    pub padding: f64,
    /// Pairs that do not keep the padding, and where.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub padding_given_up: Vec<PaddingGivenUp>,
    /// Joints of the goal that were moved to their limits.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub goal_clamped: Vec<GoalClamped>,
    /// Feasible fraction of a straight line (0–1].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fraction: Option<f64>,
    /// Seed of the search.
    pub seed: u64,
    /// Time per planning step [s]: inverse kinematics, search, shortcutting, time parameterization, checking.
    pub times: BTreeMap<String, f64>,
}

/// A pair that does not keep the padding, because it is closer at the start or the goal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct PaddingGivenUp {
    /// `start`, `goal`, or `everywhere` (closer in every configuration).
    pub near: String,
    /// The link.
    pub link: String,
    /// The obstacle, or the link of another arm.
    pub other: String,
    /// Their distance there [m]; negative if they touch.
    pub distance: f64,
}

/// A joint of a goal slightly outside its limits: the motion ends at the limit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct GoalClamped {
    /// The coordinator's joint.
    pub joint: String,
    /// Requested position [rad, or m for prismatic joints].
    pub requested: f64,
    /// Position of the limit.
    pub used: f64,
}

/// Parameters of `preview`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Preview {
    /// The plan's number; default: the newest plan that is not `by_number`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plan: Option<u64>,
    /// Rate of the points, 0.1–1000 [Hz]: the motion as the arm gets it; default: the points that define it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hz: Option<f64>,
}

impl Preview {
    pub(crate) fn valid(&self) -> Result<(), String> {
        match self.hz.filter(|hz| !(0.1..=1000.0).contains(hz)) {
            Some(hz) => Err(format!("hz is {hz}, must be within 0.1–1000")),
            None => Ok(()),
        }
    }
}

/// A plan in full.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct PreviewReply {
    /// The plan's number.
    pub plan: u64,
    /// Figures of the plan.
    pub summary: PlanSummary,
    /// Pairs of links that were not checked against each other, by reason: neighbours, those of the SRDF or the
    /// blueprint, those that touch in every configuration, what is held.
    #[serde(default)]
    pub ignored_pairs: BTreeMap<String, Vec<[String; 2]>>,
    /// The motion, with the coordinator's joint names.
    pub trajectory: Trajectory,
    /// For each robot, the position of its tool centre point at each point of the trajectory: x, y, z [m] in `map`.
    pub end_effectors: BTreeMap<String, Vec<[f64; 3]>>,
    /// For each robot, its orientation there as a quaternion x, y, z, w in `map`; with `hz` only.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub orientations: BTreeMap<String, Vec<[f64; 4]>>,
    /// For each robot, its tool centre point.
    #[serde(default)]
    pub tcps: BTreeMap<String, TcpReport>,
}

/// Parameters of `execute_plan`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ExecutePlan {
    /// The plan's number; default: the newest plan that is not `by_number`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plan: Option<u64>,
    /// Whether a motion that an obstacle blocks is planned again from where it stopped, and continues.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub replan: bool,
    /// Required for a plan of the level `fast`: it is not proven to be free.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub unproven: bool,
    /// A plan that was made for a larger speed is stretched in time to this one, 0.01–1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_speed: Option<f64>,
    /// If the motion retraces the log: time in it of the goal [s since 1970]. `motion` reports it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub retraces_to: Option<f64>,
    /// The requesting connection, if any; after its end nothing is planned again.
    #[serde(skip)]
    pub presence: Option<Presence>,
}

impl ExecutePlan {
    pub(crate) fn valid(&self) -> Result<(), String> {
        self.max_speed.map_or(Ok(()), valid_speed)
    }
}

/// Observes whether a connection is open.
#[derive(Debug, Clone)]
pub struct Presence(Weak<()>);

impl Presence {
    /// Observes a connection that keeps `alive` until its end.
    pub fn of(alive: &Arc<()>) -> Self {
        Self(Arc::downgrade(alive))
    }

    /// Returns whether the connection has ended.
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

/// Reply to `planner`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct PlannerReport {
    /// `IDLE`, `PLANNING`, `EXECUTING`, `COMPLETED`, `FAULT`.
    pub state: String,
    /// Why it is in `FAULT`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
    /// The planning robots.
    pub robots: Vec<RobotReport>,
    /// Number of the plan that `execute_plan` and `preview` take without one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plan: Option<u64>,
    /// Link pairs that touch in every configuration and are therefore not checked, by robot.
    pub always_touching: BTreeMap<String, Vec<[String; 2]>>,
}

/// A planning robot.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct RobotReport {
    /// Its name.
    pub name: String,
    /// The link of pose goals.
    pub end_effector_link: String,
    /// The tool on it; absent: none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tool: Option<ToolReport>,
    /// The coordinator's joints, in the order of joint goals.
    pub joints: Vec<String>,
    /// Lower and upper position limits [rad]; `null` for a joint without limits.
    pub limits: Vec<[Option<f64>; 2]>,
    /// The task that executes its motions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub task: Option<String>,
    /// Its named poses [rad].
    pub named_poses: BTreeMap<String, Vec<f64>>,
}
