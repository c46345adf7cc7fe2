//! A motion as a whole: one request plans, executes, follows, grips and attaches, one step after the other, and has one
//! outcome. The run carries it out; clients show it.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::on_path::{self, OnPath};
use super::until::{self, Until};
use crate::api::{Execute, ExecutePlan, ExecuteReply, GripReport, Gripper, Move, MoveReply, Plan, PlanningReport};
use crate::error::RpcError;
use crate::report::{MotionReport, PoseReport};
use crate::server::lease::Claimant;
use dimos_core::telemetry::Who;

/// Maximum number of steps.
const MAX_STEPS: usize = 64;

/// Parameters of `go`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Go {
    /// What is done, one after the other: 1 to 64 steps. Each begins when the one before it has succeeded; the first
    /// that does not ends the whole, and so does a `stop`, a `cancel`, or the end of the connection.
    pub steps: Vec<GoStep>,
    /// Whether a planned motion that an obstacle blocks is planned again from where it stopped, and continues.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub replan: bool,
    /// Required for plans of the level `fast`: they are not proven to be free.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub unproven: bool,
    /// What is done at places of the planned paths, while the arm moves. An act that is refused ends the motion.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub on_path: Vec<OnPath>,
    /// What ends motions before their goals, at most one entry per step.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub until: Vec<Until>,
    /// The requesting connection, if any: each step needs its leases.
    #[serde(skip)]
    pub claimant: Option<Claimant>,
}

/// A step of `go`: the parameters of the method that does it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum GoStep {
    /// Plans a collision-free motion from where the arm is then, and executes it.
    Plan(Box<Plan>),
    /// Executes a plan that was made before.
    ExecutePlan(Box<ExecutePlan>),
    /// Moves an arm directly: not collision-checked; in a run with a planner only with `direct`.
    Move(Box<Move>),
    /// Follows a trajectory: not collision-checked.
    Execute(Box<Execute>),
    /// Commands a gripper, and waits until its fingers are at rest.
    Gripper(Box<GoGripper>),
}

/// A step that grips: the parameters of `gripper`, and what becomes of objects in the planner's world.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct GoGripper {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// Where the fingers go.
    pub to: Opening,
    /// Largest force [`gripper_force_unit` in `status`]; default: the one set in the device.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub force: Option<f64>,
    /// Fraction of the gripper's top speed, 0.01–1; default: the speed set in the device.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub speed: Option<f64>,
    /// Time for the outcome [s], at most 600; default: 20.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub timeout: Option<f64>,
    /// What becomes of objects; default: nothing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub objects: Option<GripObjects>,
}

/// Where fingers go: `"open"`, `"close"`, or a position [`gripper_unit` in `status`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged)]
pub enum Opening {
    /// This position [m or rad].
    Position(f64),
    /// An end of its range.
    End(GripperEnd),
}

/// An end of a gripper's range.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum GripperEnd {
    /// Fully open.
    Open,
    /// Closed.
    Close,
}

/// What becomes of objects in the planner's world once the fingers are at rest.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum GripObjects {
    /// This one is attached to the arm if it is held; else the step fails.
    Attach(String),
    /// All that the arm holds are detached.
    Detach,
    /// This one is detached if the arm holds it, else attached.
    Either(String),
}

impl Go {
    pub(crate) fn valid(&self) -> Result<(), String> {
        if !(1..=MAX_STEPS).contains(&self.steps.len()) {
            return Err(format!("steps has {} steps, must have 1 to {MAX_STEPS}", self.steps.len()));
        }
        self.steps.iter().enumerate().try_for_each(|(index, step)| {
            let (name, valid) = match step {
                GoStep::Plan(plan) => ("plan", plan.valid()),
                GoStep::ExecutePlan(execute) => ("execute_plan", execute.valid()),
                GoStep::Move(direct) => ("move", direct.valid()),
                GoStep::Execute(execute) => ("execute", execute.valid()),
                GoStep::Gripper(gripper) => ("gripper", gripper.command(0.0).valid().and(gripper.to.valid())),
            };
            valid.map_err(|what| format!("steps[{index}].{name}.{what}"))
        })?;
        on_path::valid(&self.on_path, &self.steps, self.replan)?;
        until::valid(&self.until, &self.steps, self.replan)
    }
}

impl Opening {
    fn valid(self) -> Result<(), String> {
        match self {
            Self::Position(position) if !position.is_finite() => Err(format!("to is {position}, which is not finite")),
            _ => Ok(()),
        }
    }
}

impl GoGripper {
    /// Returns the command to a position [m or rad].
    pub fn command(&self, position: f64) -> Gripper {
        let Self { arm, force, speed, timeout, .. } = self.clone();
        Gripper { arm, position, force, speed, timeout }
    }
}

/// Reply to `go`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct GoReply {
    /// Its number, for `going` and `cancel`.
    pub going: u64,
}

/// Parameters of `going`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Going {
    /// The number that `go` replied.
    pub going: u64,
}

/// What is being done for a request `go`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum GoPhase {
    /// A motion is planned, checked, or about to begin.
    #[default]
    Planning,
    /// An arm moves.
    Executing,
    /// A motion that an obstacle blocks is planned again.
    Replanning,
    /// Fingers move.
    Gripping,
    /// It is over.
    Ended,
}

/// Reply to `going`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct GoingReport {
    /// Its number.
    pub going: u64,
    /// What is being done.
    pub phase: GoPhase,
    /// Whether it is over: nothing of it moves, nor will.
    pub done: bool,
    /// Who asked for it; absent: the run itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub by: Option<Who>,
    /// The steps that have begun, in order.
    pub steps: Vec<GoStepReport>,
    /// Why a step did not begin, or did not succeed; absent if a motion has begun and ended elsewhere: its `error`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<RpcError>,
    /// How it ended, when done.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub outcome: Option<GoOutcome>,
}

/// What has been done for a step.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct GoStepReport {
    /// Progress or result of planning.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub planning: Option<PlanningReport>,
    /// The reply to the request that began its motion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub begun: Option<GoBegun>,
    /// Its motion; those that continue it around obstacles follow.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub motions: Vec<MotionReport>,
    /// Progress or outcome of the gripper's command.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub grip: Option<GripReport>,
    /// Objects that were attached.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub attached: Vec<String>,
    /// Objects that were detached.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub detached: Vec<String>,
    /// With `stiffness` in `until`: the force to expect at most [N].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub peak: Option<f64>,
    /// Acts on its path that were done, in order.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub acts: Vec<ActDone>,
}

/// An act on a path that was done.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ActDone {
    /// Its index in `on_path`.
    pub on_path: usize,
    /// Where it was asked for: time along the path [s].
    pub elapsed: f64,
}

/// How a motion of a step began: the reply to `move`, or to `execute` and `execute_plan`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged)]
pub enum GoBegun {
    /// Directly.
    Move(MoveReply),
    /// Along a trajectory, of a plan or of the client.
    Execute(ExecuteReply),
}

impl GoBegun {
    /// Returns the number of the motion.
    pub fn motion(&self) -> u64 {
        match self {
            Self::Move(reply) => reply.motion,
            Self::Execute(reply) => reply.motion,
        }
    }

    /// Returns the task that executes it.
    pub fn task(&self) -> &str {
        match self {
            Self::Move(reply) => &reply.task,
            Self::Execute(reply) => &reply.task,
        }
    }
}

/// How a request `go` ended: the last report of its last motion, if there was one, and the cause.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct GoOutcome {
    /// The last motion.
    #[serde(flatten, default, skip_serializing_if = "Option::is_none")]
    pub motion: Option<MotionReport>,
    /// What ended it.
    pub ended_by: EndedBy,
    /// What was measured of the cause: for `gap`, the distance of the joint from its path [rad]; for a condition of
    /// `until`, N, Nm, m, s, or 1 for a high and 0 for a low input; absent for others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub value: Option<f64>,
    /// Pose of the tool centre point at the end; absent if none is known, or if several arms have moved.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pose: Option<PoseReport>,
}

/// What ended a request `go`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum EndedBy {
    /// All steps succeeded. With `until`: the goal came before what was awaited.
    Goal,
    /// The force that was awaited.
    Force,
    /// The torque that was awaited.
    Torque,
    /// The input that was awaited.
    Input,
    /// The distance of `until`.
    Distance,
    /// The time of `until`.
    Time,
    /// An operator's stop.
    Stop,
    /// A `cancel`.
    Cancelled,
    /// Its connection has ended.
    ClientGone,
    /// Another task of higher priority took the arm.
    Replaced,
    /// Something is in the way, or no longer known to be out of it.
    Blocked,
    /// A gap in the setpoints.
    Gap,
    /// The arm is held for another cause, or the motion did not get to its goal.
    Fault,
    /// There is no plan.
    NoPlan,
    /// The gripper did not do what it should.
    Grip,
    /// The run refused a step: `error` says why.
    Refused,
    /// A cause of a newer version.
    #[default]
    #[serde(other)]
    Other,
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::api::Request;

    #[test]
    fn a_mistake_is_named_with_its_step() {
        let refused = |params| Request::read("go", params).unwrap_err().message;
        let grip = |to| json!({"gripper": {"arm": "arm", "to": to}});
        assert!(refused(json!({"steps": []})).contains("0 steps, must have 1 to 64"));
        let fast = json!({"move": {"arm": "arm", "target": [0.1], "speed": 2}});
        assert!(refused(json!({"steps": [grip(json!("open")), fast]})).contains("steps[1].move.speed is 2"));
        assert!(refused(json!({"steps": [{"plan": {"goals": []}}]})).contains("steps[0].plan.goals is empty"));
        assert!(Request::read("go", json!({"steps": [grip(json!("ajar"))]})).is_err());
        let read = Request::read("go", json!({"steps": [grip(json!(0.03)), grip(json!("close"))]})).unwrap();
        let Request::Go(Go { steps, .. }) = read else { panic!() };
        let to = |step: &GoStep| if let GoStep::Gripper(gripper) = step { Some(gripper.to) } else { None };
        let to: Vec<_> = steps.iter().filter_map(to).collect();
        assert_eq!(to, [Opening::Position(0.03), Opening::End(GripperEnd::Close)]);
    }

    #[test]
    fn an_outcome_has_the_fields_of_its_motion_beside_its_own() {
        let motion = MotionReport { motion: 7, state: "COMPLETED".into(), done: true, ..MotionReport::default() };
        let outcome = GoOutcome { motion: Some(motion), ended_by: EndedBy::Goal, ..GoOutcome::default() };
        let json = serde_json::to_value(&outcome).unwrap();
        assert_eq!((&json["state"], &json["ended_by"]), (&json!("COMPLETED"), &json!("goal")));
        assert_eq!(serde_json::from_value::<GoOutcome>(json).unwrap(), outcome);
        let none = json!({"ended_by": "no_plan"});
        assert_eq!(serde_json::from_value::<GoOutcome>(none).unwrap().motion, None);
    }
}
