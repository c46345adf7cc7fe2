//! How a planner in another process and its run talk: the process connects like any client and registers; the run then
//! sends it what planning is asked of it, as messages of the stream `planner_requests`, and it answers each with
//! `planner_answer`.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::api::{Done, Method};
use super::error::RpcError;
use super::motion_api::Trajectory;

/// Name of the stream of what a run asks its planner.
pub const PLANNER_REQUESTS: &str = "planner_requests";
/// Longest line of a connection that registered a planner, newline included [bytes]: plans are long.
pub const MAX_ANSWER: usize = 16 << 20;

/// Parameters of `register_planner`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RegisterPlanner {
    /// What the planner is called, in `status`.
    pub name: String,
    /// The robots that it plans for.
    pub robots: Vec<RegisteredRobot>,
}

/// A robot of a planner that registers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RegisteredRobot {
    /// Its name in the planner.
    pub name: String,
    /// The coordinator's joints that it has.
    pub joints: Vec<String>,
    /// The trajectory task that executes its motions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub task: Option<String>,
}

/// Reply to `register_planner`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Registered {
    /// The run.
    pub run: String,
    /// How far and how fast each of the joints may be commanded.
    pub limits: BTreeMap<String, CommandLimits>,
}

/// How far and how fast a joint may be commanded.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct CommandLimits {
    /// Lowest and highest position [rad]: the arm's own limits, narrowed by the blueprint, 0.01 rad inside.
    pub position: [f64; 2],
    /// Highest speed [rad/s].
    pub velocity: f64,
    /// Highest acceleration [rad/s²].
    pub acceleration: f64,
    /// Highest jerk [rad/s³].
    pub jerk: f64,
}

/// What a run asks its planner: `data` of a message of the stream `planner_requests`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct PlannerRequest {
    /// Its number, for the answer.
    pub request: u64,
    /// The method that was asked: `plan`, `world_add`, `cancel`, …
    pub method: String,
    /// Its parameters.
    #[serde(default)]
    pub params: Value,
    /// What the run knows and the planner needs.
    #[serde(default)]
    pub moment: Moment,
}

/// What a planner needs to know of the run at the moment of a request.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Moment {
    /// The number of the plan that begins now.
    pub plan: u64,
    /// Where joints are [rad]: where they are commanded to be, where positions are commanded. Without those whose arm
    /// has not been heard of for 1 s.
    pub positions: BTreeMap<String, f64>,
    /// How far the grippers of arms are open, 0–1, by each of their arm's joints.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub grippers: BTreeMap<String, f64>,
}

/// Parameters of `planner_answer`: one of `result` and `error`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PlannerAnswer {
    /// Number of the request.
    pub request: u64,
    /// What the method replies; to `execute_plan`, a [`ReleasedPlan`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub result: Option<Value>,
    /// Why it is refused.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<RpcError>,
}

/// Name of what a run asks its planner after every change of the world, for each planned motion under way.
pub const RECHECK: &str = "recheck";

/// Parameters of `recheck`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Recheck {
    /// The plan that is being carried out.
    pub plan: u64,
    /// How far its motion is [s].
    pub elapsed: f64,
}

/// Reply to `recheck`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct RecheckReply {
    /// What is in the way of the rest of the motion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub blocked: Option<BlockedReport>,
}

/// What is in the way of a motion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct BlockedReport {
    /// Up to here the motion keeps its distance [s since its start].
    pub free_until: f64,
    /// What is in the way, with names and distances.
    pub what: String,
}

/// A plan that is still free, for the coordinator to execute.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ReleasedPlan {
    /// The plan's number.
    pub plan: u64,
    /// Its motion.
    pub trajectory: Trajectory,
    /// The task that executes it; without one, that whose joints cover it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub task: Option<String>,
}

impl RegisterPlanner {
    fn valid(&self) -> Result<(), String> {
        if self.name.is_empty() || self.name.len() > 64 || self.name.chars().any(char::is_control) {
            return Err("name must have 1 to 64 characters, and no control characters".into());
        }
        if self.robots.is_empty() || self.robots.iter().any(|robot| robot.joints.is_empty()) {
            return Err("a planner has robots, and a robot has joints".into());
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
            _ => Err("an answer has a result or an error".into()),
        }
    }
}
