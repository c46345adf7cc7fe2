//! Protocol between a run and a planner in another process: the planner connects like any client and registers. The run
//! then forwards planner requests as messages of the stream `planner_requests`; the planner answers each with
//! `planner_answer`.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::api::motion::Trajectory;
use crate::api::planner::PoseSpec;
use crate::api::{Done, Method};
use crate::error::RpcError;
use crate::report::TcpReport;
pub use dimos_core::joint::CommandLimits;

/// Name of the stream of requests to an attached planner.
pub const PLANNER_REQUESTS: &str = "planner_requests";
/// Maximum length of a line from an attached planner, including its newline [bytes]: plans are long.
pub const MAX_ANSWER: usize = 16 << 20;

/// Parameters of `register_planner`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RegisterPlanner {
    /// The planner's name in `status`.
    pub name: String,
    /// The robots that it plans for.
    pub robots: Vec<RegisteredRobot>,
}

/// A robot of an attached planner.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RegisteredRobot {
    /// Its name in the planner.
    pub name: String,
    /// Its joints, by their names in the coordinator, in the order of joint goals.
    pub joints: Vec<String>,
    /// The trajectory task that executes its motions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub task: Option<String>,
    /// Its model, with which the run computes its poses.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub model: Option<RegisteredModel>,
}

/// The kinematics of a robot of an attached planner.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RegisteredModel {
    /// Kinematics of its joints, as in a log.
    pub kinematics: Value,
    /// Index of its end-effector link in the kinematics.
    pub index: usize,
    /// Pose of the model's root in `map`.
    pub root: PoseSpec,
    /// Its tool centre point.
    pub tcp: TcpReport,
    /// Its flange; absent if the model does not name it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub flange: Option<RegisteredFlange>,
    /// Whether planned motions are made although the model does not fit the arm.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub allows_mismatch: bool,
}

/// Where the flange and the base of the arm's controller are in a model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RegisteredFlange {
    /// Index of the flange's link in the kinematics.
    pub link: usize,
    /// Index of the link that carries the controller's base.
    pub base_link: usize,
    /// Pose of that base in the link's frame.
    pub base: PoseSpec,
}

/// Reply to `register_planner`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Registered {
    /// Name of the run.
    pub run: String,
    /// Command limits of each joint.
    pub limits: BTreeMap<String, CommandLimits>,
}

/// A request to an attached planner: `data` of a message of the stream `planner_requests`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct PlannerRequest {
    /// Number of the request, for the answer.
    pub request: u64,
    /// The method: `plan`, `world_add`, `cancel`, …
    pub method: String,
    /// Its parameters.
    #[serde(default)]
    pub params: Value,
    /// State of the run at the time of the request.
    #[serde(default)]
    pub moment: Moment,
}

/// State of the run that a planner needs to answer a request.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Moment {
    /// Number for a plan that this request begins.
    pub plan: u64,
    /// Joint positions [rad]: commanded, or measured if the joint is not commanded in positions. Joints without a state
    /// for 1 s are missing.
    pub positions: BTreeMap<String, f64>,
    /// Opening of the gripper (0–1), listed for each joint of its arm.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub grippers: BTreeMap<String, f64>,
    /// Distance that plans keep beyond the padding, because an arm is that far from its model; listed for each joint of
    /// the arm [m].
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub paddings: BTreeMap<String, f64>,
}

/// Parameters of `planner_answer`: one of `result` and `error`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PlannerAnswer {
    /// Number of the request.
    pub request: u64,
    /// Reply of the method; for `execute_plan`, a [`ReleasedPlan`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub result: Option<Value>,
    /// The error.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<RpcError>,
}

/// Method that a run sends to its planner after every change of the world, for each planned motion in progress.
pub const RECHECK: &str = "recheck";

/// Parameters of `recheck`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Recheck {
    /// The plan that is being executed.
    pub plan: u64,
    /// Elapsed time of its motion [s].
    pub elapsed: f64,
}

/// Reply to `recheck`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct RecheckReply {
    /// What blocks the rest of the motion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub blocked: Option<BlockedReport>,
}

/// An obstacle to a motion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct BlockedReport {
    /// Time up to which the motion keeps its clearance [s since its start].
    pub free_until: f64,
    /// Link, obstacle and distance, as text.
    pub what: String,
}

/// A plan that is still collision-free, for the coordinator to execute.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ReleasedPlan {
    /// The plan's number.
    pub plan: u64,
    /// Its motion.
    pub trajectory: Trajectory,
    /// The task that executes it; default: the one whose joints cover it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub task: Option<String>,
}

impl RegisterPlanner {
    fn valid(&self) -> Result<(), String> {
        if self.name.is_empty() || self.name.len() > 64 || self.name.chars().any(char::is_control) {
            return Err("name must have 1 to 64 characters without control characters".into());
        }
        if self.robots.is_empty() || self.robots.iter().any(|robot| robot.joints.is_empty()) {
            return Err("a planner needs robots, and each robot needs joints".into());
        }
        Ok(())
    }
}

impl Method for RegisterPlanner {
    const NAME: &'static str = "register_planner";
    type Reply = Registered;

    fn check(&self) -> Result<(), String> {
        self.valid()
    }
}

impl Method for PlannerAnswer {
    const NAME: &'static str = "planner_answer";
    type Reply = Done;

    fn check(&self) -> Result<(), String> {
        match (&self.result, &self.error) {
            (Some(_), None) | (None, Some(_)) => Ok(()),
            _ => Err("an answer must have either a result or an error".into()),
        }
    }
}
