//! The results of the coordinator's calls, as objects of Python dimos' classes.

use super::arguments::python_list;
use super::pickle_writer::{Value, texts};
use crate::rpc::client::ClientError;
use crate::rpc::error::Code;
use crate::rpc::report::MotionReport;

/// Module of the trajectory task's classes.
const TASK_MODULE: &str = "dimos.control.tasks.trajectory_task.trajectory_task";
/// Module of a trajectory's state.
const STATUS_MODULE: &str = "dimos.msgs.trajectory_msgs.TrajectoryStatus";

/// Whether a trajectory was accepted: `TrajectoryExecutionStatus`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Execution {
    /// It is being executed.
    Accepted = 1,
    /// No trajectory task has these joints.
    NoTrajectoryTask = 2,
    /// It is not valid, or refused for a reason in the message.
    InvalidTrajectory = 3,
    /// The arm's state is unknown.
    StartStateUnavailable = 4,
    /// The arm is elsewhere.
    StartStateMismatch = 5,
    /// Another motion is being executed.
    AlreadyExecuting = 6,
}

impl Execution {
    /// Returns the status for a refusal of the run.
    pub fn of(code: Code) -> Self {
        match code {
            Code::NoTrajectoryTask => Self::NoTrajectoryTask,
            Code::StartStateUnavailable => Self::StartStateUnavailable,
            Code::StartStateMismatch => Self::StartStateMismatch,
            Code::AlreadyExecuting => Self::AlreadyExecuting,
            _ => Self::InvalidTrajectory,
        }
    }

    /// Returns the `TrajectoryExecutionResult`.
    pub fn result(self, message: impl Into<Value>) -> Value {
        outcome(["TrajectoryExecutionStatus", "TrajectoryExecutionResult"], self as i64, message.into())
    }
}

/// Returns an object of a class, with a member of the enumeration of its status.
fn outcome([status, class]: [&'static str; 2], member: i64, message: Value) -> Value {
    let status = Value::Member(TASK_MODULE, status, member);
    Value::Object(TASK_MODULE, class, Box::new(Value::Dict(vec![("status", status), ("message", message)])))
}

/// Outcome of a cancellation: `TrajectoryCancellationStatus`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cancellation {
    /// A motion is being ended.
    Cancelled = 1,
    /// There was none.
    AlreadyStopped = 2,
    /// The coordinator has no trajectory task.
    NoTrajectoryTask = 3,
    /// It may continue.
    Uncertain = 4,
}

impl Cancellation {
    /// Returns the `TrajectoryCancellationResult`.
    pub fn result(self, message: impl Into<Value>) -> Value {
        outcome(["TrajectoryCancellationStatus", "TrajectoryCancellationResult"], self as i64, message.into())
    }
}

/// State of a trajectory: `TrajectoryState`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    /// None yet.
    Idle = 0,
    /// It is being executed, or the arm decelerates.
    Executing = 1,
    /// It has reached its goal.
    Completed = 2,
    /// It has ended elsewhere.
    Aborted = 3,
    /// It has ended with a fault.
    Fault = 4,
}

impl State {
    /// Returns the state of a motion; it ends when the arm is at rest.
    pub fn of(motion: Option<&MotionReport>) -> Self {
        match motion {
            None => Self::Idle,
            Some(motion) if !motion.done => Self::Executing,
            Some(motion) => match motion.state.as_str() {
                "COMPLETED" if motion.error.is_none() => Self::Completed,
                "FAULT" => Self::Fault,
                _ => Self::Aborted,
            },
        }
    }

    /// Returns the member of `TrajectoryState`.
    pub fn member(self) -> Value {
        Value::Member(STATUS_MODULE, "TrajectoryState", self as i64)
    }
}

/// Returns the `TrajectoryStatus` of a motion. `stamp`: now [s since the Unix epoch].
pub fn status(motion: Option<&MotionReport>, stamp: f64) -> Value {
    let state = State::of(motion);
    let (progress, elapsed, remaining) = match motion {
        _ if state == State::Idle => (0.0, 0.0, 0.0),
        Some(motion) if state == State::Completed => (1.0, motion.elapsed, 0.0),
        Some(motion) if state == State::Executing => (motion.progress, motion.elapsed, motion.remaining),
        Some(motion) => (motion.progress, motion.elapsed, 0.0),
        None => (0.0, 0.0, 0.0),
    };
    let error = motion.and_then(|motion| motion.error.clone()).filter(|_| state != State::Executing);
    let fields = vec![
        ("error", Value::Text(error.unwrap_or_default())),
        ("progress", Value::Float(progress)),
        ("state", state.member()),
        ("time_elapsed", Value::Float(elapsed)),
        ("time_remaining", Value::Float(remaining)),
        ("timestamp", Value::Float(stamp)),
    ];
    // A class with slots has its state in the second place.
    let state = Value::Tuple(vec![Value::None, Value::Dict(fields)]);
    Value::Object(STATUS_MODULE, "TrajectoryStatus", Box::new(state))
}

/// Returns the result for a trajectory that the run refused; `None`: it may have been accepted.
pub fn refusal(error: &ClientError, text: String) -> Option<Value> {
    match error {
        ClientError::Refused(error) if error.code == Code::NoAnswer => None,
        ClientError::Refused(error) => Some(Execution::of(error.code).result(text)),
        _ => None,
    }
}

/// Commands of the trajectory task, with their parameters.
pub const TRAJECTORY_COMMANDS: [(&str, &[&str]); 4] = [
    ("cancel", &[]),
    ("execute", &["trajectory", "current_positions"]),
    ("get_state", &[]),
    ("get_status", &["t_now"]),
];
/// Commands of a gripper task.
pub const GRIPPER_COMMANDS: [(&str, &[&str]); 4] = [
    ("get_normalized", &[]),
    ("get_position", &[]),
    ("set_normalized", &["values", "t_now"]),
    ("set_position", &["values", "t_now"]),
];

/// Returns the description of a task.
pub fn description(task: &str, commands: &[(&'static str, &[&str])]) -> Value {
    let command = |(name, parameters): &(&'static str, &[&str])| {
        let signature = format!("({})", parameters.join(", "));
        (*name, Value::Dict(vec![("signature", signature.into()), ("params", texts(parameters.iter()))]))
    };
    let commands = Value::Dict(commands.iter().map(command).collect());
    Value::Dict(vec![("task", task.into()), ("commands", commands), ("streams", Value::List(Vec::new()))])
}

/// Returns the text of the error for a command that a task lacks.
pub fn no_command(task: &str, method: &str, commands: &[(&str, &[&str])]) -> String {
    let names: Vec<&str> = commands.iter().map(|(name, _)| *name).collect();
    let shown: String = method.chars().take(80).collect();
    let declared = python_list(&names);
    format!("task_invoke('{task}', '{shown}'): task has no such method; declared commands: {declared}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_motion_is_completed_only_at_its_goal_and_at_rest() {
        let motion = |state: &str, done: bool, error: Option<&str>| MotionReport {
            state: state.into(),
            done,
            error: error.map(str::to_owned),
            ..MotionReport::default()
        };
        for (state, done, error, wanted) in [
            ("EXECUTING", false, None, State::Executing),
            ("CANCELLING", false, None, State::Executing),
            ("ABORTED", false, None, State::Executing),
            ("COMPLETED", true, None, State::Completed),
            ("COMPLETED", true, Some("missed its goal"), State::Aborted),
            ("ABORTED", true, Some("cancelled"), State::Aborted),
            ("FAULT", true, None, State::Fault),
        ] {
            assert_eq!(State::of(Some(&motion(state, done, error))), wanted, "{state} {done} {error:?}");
        }
        assert_eq!(State::of(None), State::Idle);
    }

    #[test]
    fn refusals_keep_their_meaning_where_python_dimos_has_it() {
        for (code, wanted) in [
            (Code::NoTrajectoryTask, Execution::NoTrajectoryTask),
            (Code::StartStateMismatch, Execution::StartStateMismatch),
            (Code::StartStateUnavailable, Execution::StartStateUnavailable),
            (Code::AlreadyExecuting, Execution::AlreadyExecuting),
            (Code::LeaseHeld, Execution::InvalidTrajectory),
            (Code::ArmLatched, Execution::InvalidTrajectory),
        ] {
            assert_eq!(Execution::of(code), wanted);
        }
    }
}
