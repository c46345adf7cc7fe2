//! Errors of requests: a code for programs, a message and a hint for people.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use dimos_core::telemetry::Outcome;
use dimos_yaml::{did_you_mean, quote};

/// Error code for programs; in JSON: `START_STATE_MISMATCH`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub enum Code {
    /// The line is not a JSON object with `id`, `method`, `params`.
    Malformed,
    /// The line is longer than [`MAX_LINE`](super::api::MAX_LINE); the connection ends.
    TooLarge,
    /// The run has the maximum number of connections, or closed this idle one; the connection ends.
    TooManyConnections,
    /// The connection has the maximum number of subscriptions.
    TooManySubscriptions,
    /// The socket belongs to another user, and the connection ends; or the role of the client does not include the
    /// request.
    Forbidden,
    /// No one listens at the place, or it does not accept this client's certificate.
    Unreachable,
    /// The connection to another computer is lost. A request that was pending may still take effect. If the client held
    /// a lease, it must take it again.
    Lost,
    /// The client has the maximum number of requests pending.
    TooManyRequests,
    /// Another gateway shares the run.
    HasGateway,
    /// No such method.
    UnknownMethod,
    /// The parameters do not fit the method.
    InvalidParams,
    /// No such arm in the run.
    UnknownArm,
    /// No such task in the run.
    UnknownTask,
    /// No such motion, or it is too old.
    UnknownMotion,
    /// No such subscription on this connection.
    UnknownSubscription,
    /// Another connection holds the arm's lease; the message names its process.
    LeaseHeld,
    /// The run has no planner.
    NoPlanner,
    /// The run already has a planner.
    HasPlanner,
    /// The run has a planner, and the motion is not planned: plan it, or ask for a direct motion.
    NotPlanned,
    /// No such robot in the planner.
    UnknownRobot,
    /// No such plan, or it is too old.
    UnknownPlan,
    /// There is no plan yet, or planning found none; the message says why.
    NoPlan,
    /// The world has changed since the plan was made, and now blocks it.
    PlanOutdated,
    /// The model of the arm has its flange elsewhere than the arm's controller: nothing is planned with it.
    ModelMismatch,
    /// The plan is not proven to be free of contact, and the request does not say that this is wanted.
    PlanUnproven,
    /// No such object in the world.
    UnknownObject,
    /// The object does not allow the request: an arm holds it, or none does.
    WrongObject,
    /// The planner is busy with another request.
    Planning,
    /// No trajectory task covers these joints.
    NoTrajectoryTask,
    /// The trajectory is invalid: empty, times that do not increase, wrong number of values.
    InvalidTrajectory,
    /// The task is executing already.
    AlreadyExecuting,
    /// The trajectory does not start at the arm's position.
    StartStateMismatch,
    /// No fresh state of the arm.
    StartStateUnavailable,
    /// The arm is not ready for motion.
    ArmNotReady,
    /// The arm is held and must be reset first.
    ArmLatched,
    /// The fault that latched the arm is still present.
    StillFaulted,
    /// A motion reached its goal, or a limit of distance or time, before what was awaited.
    NotMet,
    /// The task does not support the request.
    WrongTask,
    /// A number is not finite.
    NonFinite,
    /// A target is outside the joint's limits.
    OutOfLimits,
    /// A target of a stream is further from the one before than the joint gets in that time: it is left out, and the
    /// stream continues.
    OutOfReach,
    /// The arm has no gripper.
    NoGripper,
    /// Fingers did not get to their position, or hold nothing that should be attached; or nothing can be detached.
    GripFailed,
    /// The arm was stopped, held, disabled or disconnected, or another client took its lease, after the motion had been
    /// requested; the message says which.
    Superseded,
    /// The arm or the run lacks this feature.
    Unsupported,
    /// The arm's controller refused; the message has its text.
    DeviceRefused,
    /// The run is shutting down.
    ShuttingDown,
    /// The run did not answer in time; the request may still take effect.
    NoAnswer,
    /// A defect of the program.
    Internal,
    /// A code of a newer version.
    #[serde(other)]
    Other,
}

impl Code {
    /// Returns the code as in JSON and messages.
    pub fn name(self) -> String {
        serde_json::to_value(self).ok().and_then(|v| v.as_str().map(str::to_owned)).unwrap_or_default()
    }

    /// Returns the code of a refusal by the tick; `None` if the request was accepted.
    pub fn of(outcome: &Outcome) -> Option<Self> {
        match outcome {
            Outcome::Accepted | Outcome::Cancelled | Outcome::AlreadyStopped => None,
            Outcome::AlreadyExecuting(_) => Some(Self::AlreadyExecuting),
            Outcome::StartStateMismatch(..) => Some(Self::StartStateMismatch),
            Outcome::StartStateUnavailable(_) => Some(Self::StartStateUnavailable),
            Outcome::ArmNotReady(..) | Outcome::ArmMoving(_) | Outcome::Paused => Some(Self::ArmNotReady),
            Outcome::ArmLatched(..) => Some(Self::ArmLatched),
            Outcome::StillFaulted(..) => Some(Self::StillFaulted),
            Outcome::WrongTask(_) => Some(Self::WrongTask),
            Outcome::NonFinite(_) => Some(Self::NonFinite),
            Outcome::InvalidTarget(_) => Some(Self::InvalidParams),
            Outcome::OutOfReach(..) => Some(Self::OutOfReach),
            Outcome::OutOfLimits(..) | Outcome::GripperOutOfLimits(..) | Outcome::GripperForceOutOfLimits(..) => {
                Some(Self::OutOfLimits)
            }
            Outcome::NoGripperForce(_) | Outcome::NoGripperSpeed(_) => Some(Self::Unsupported),
            Outcome::NoGripper(_) => Some(Self::NoGripper),
            Outcome::Superseded(..) => Some(Self::Superseded),
            Outcome::ShuttingDown => Some(Self::ShuttingDown),
        }
    }
}

/// A refused request.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, thiserror::Error)]
#[error("{message}")]
pub struct RpcError {
    /// Error code for programs.
    pub code: Code,
    /// What went wrong, without full stop.
    pub message: String,
    /// What to do about it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hint: Option<String>,
    /// Details for programs: the joint, the amount.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub data: Option<Value>,
}

impl RpcError {
    /// Creates an error without hint and data.
    pub fn new(code: Code, message: impl Into<String>) -> Self {
        Self { code, message: message.into(), hint: None, data: None }
    }

    /// Adds a hint.
    pub fn hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = Some(hint.into());
        self
    }

    /// Adds details for programs.
    pub fn data(mut self, data: Value) -> Self {
        self.data = Some(data);
        self
    }

    /// Creates the error for an unknown name; the hint suggests the most similar of `known`, or lists them.
    pub fn unknown<S: AsRef<str>>(code: Code, what: &str, name: &str, known: &[S]) -> Self {
        let error = Self::new(code, format!("no {what} named {}", quote(name)));
        let hint = did_you_mean(name, known.iter().map(AsRef::as_ref), "there is");
        error.hint(hint.unwrap_or_else(|| format!("there is no {what} here")))
    }
}
