//! Result of a verb: an exit code for scripts, an error with a hint for people.

use std::fmt::Display;

use serde_json::{Value, json};

use crate::runtime::StartError;
use dimos_core::message::Message;
use dimos_rpc::client::ClientError;
use dimos_rpc::{Code, RpcError};

/// The exit codes; scripts depend on them. `dimos --help` lists them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Exit {
    /// Done.
    Ok = 0,
    /// Failed, refused, or not confirmed.
    Failed = 1,
    /// The command line, the blueprint or a file is wrong.
    Usage = 2,
    /// Hardware unreachable.
    Hardware = 3,
    /// A run ended by a fault.
    Fault = 4,
    /// A log is cut or has lost data, or a run ended because its log could not be written: the disk is full, or the log
    /// was removed.
    Log = 5,
    /// Ended by SIGINT, after the controlled stop.
    Interrupted = 130,
    /// Ended by SIGTERM, after the controlled stop.
    Terminated = 143,
}

impl Exit {
    /// Exit code of log readers when a log is cut or data is missing.
    pub const DATA_LOST: Self = Self::Log;

    /// All exit codes with their meaning.
    pub const ALL: &[(Self, &str)] = &[
        (Self::Ok, "done"),
        (Self::Failed, "failed, refused, or not confirmed"),
        (Self::Usage, "the command line, a blueprint, a model or a file is wrong"),
        (Self::Hardware, "hardware unreachable"),
        (Self::Fault, "a run ended by a fault"),
        (Self::Log, "a log is cut, damaged, has lost data, or could not be written"),
        (Self::Interrupted, "ended by SIGINT, after the controlled stop"),
        (Self::Terminated, "ended by SIGTERM, after the controlled stop"),
    ];

    /// Returns the exit code of a number; an unknown one (a crash) counts as failed.
    pub fn of(code: u8) -> Self {
        Self::ALL.iter().map(|(exit, _)| *exit).find(|exit| *exit as u8 == code).unwrap_or(Self::Failed)
    }

    /// Returns its name in the errors of `--json`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ok => "OK",
            Self::Failed => "FAILED",
            Self::Usage => "USAGE",
            Self::Hardware => "HARDWARE",
            Self::Fault => "FAULT",
            Self::Log => "LOG",
            Self::Interrupted => "INTERRUPTED",
            Self::Terminated => "TERMINATED",
        }
    }

    /// Returns the exit code after a signal.
    pub fn by_signal(signal: i32) -> Self {
        if signal == libc::SIGTERM { Self::Terminated } else { Self::Interrupted }
    }
}

/// Why a verb failed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{what}")]
pub struct Failure {
    /// The exit code.
    pub exit: Exit,
    /// What went wrong, without full stop; further lines may show details.
    pub what: String,
    /// What to do about it.
    pub hint: Option<String>,
    /// Code of the run that refused a request: `UNKNOWN_ARM`. Empty for failures of this program itself.
    pub code: String,
    /// Further data for programs: what a run sent with its refusal, or the mistakes of a blueprint.
    pub data: Option<Box<Value>>,
}

/// Result of a verb.
pub type Result<T = Exit> = std::result::Result<T, Failure>;

impl Failure {
    /// Creates a failure without a hint.
    pub fn new(exit: Exit, what: impl Into<String>) -> Self {
        Self { exit, what: without_number(what.into()), hint: None, code: String::new(), data: None }
    }

    /// Creates a failure from the text of an error, which may end with a hint.
    pub fn of(exit: Exit, error: impl Display) -> Self {
        let Message { what, hint } = Message::of(error);
        Self::new(exit, what).maybe_hint(hint)
    }

    /// Creates a failure for wrong arguments or a wrong file.
    pub fn usage(what: impl Into<String>) -> Self {
        Self::new(Exit::Usage, what)
    }

    /// Adds a hint.
    pub fn hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = Some(hint.into());
        self
    }

    /// Adds a hint if there is one.
    pub fn maybe_hint(self, hint: Option<String>) -> Self {
        Self { hint: hint.or(self.hint), ..self }
    }

    /// Adds data for programs.
    pub fn data(self, data: Value) -> Self {
        Self { data: Some(Box::new(data)), ..self }
    }

    /// Returns the failure as `--json` prints it: `{"error": {"code", "message", "hint", "data"}}`. Without a code of a
    /// run it is the name of the exit code.
    pub fn to_json(&self) -> Value {
        let code = if self.code.is_empty() { self.exit.name() } else { &self.code };
        json!({"error": {"code": code, "message": self.what, "hint": self.hint, "data": self.data}})
    }
}

/// Shows an error with its context: `FILE: permission denied`.
impl From<anyhow::Error> for Failure {
    fn from(error: anyhow::Error) -> Self {
        error.downcast().unwrap_or_else(|error| Self::of(Exit::Failed, format_args!("{error:#}")))
    }
}

impl From<StartError> for Failure {
    fn from(error: StartError) -> Self {
        let exit = match error {
            StartError::Hardware { .. } => Exit::Hardware,
            StartError::Blueprint { .. } => Exit::Usage,
            StartError::Other { .. } => Exit::Failed,
        };
        Self::new(exit, error.to_string()).hint(error.hint())
    }
}

impl From<ClientError> for Failure {
    fn from(error: ClientError) -> Self {
        let exit = match &error {
            ClientError::SeveralRuns(_) | ClientError::UnknownRun { .. } => Exit::Usage,
            ClientError::Refused(refusal) => exit_of(refusal.code),
            _ => Exit::Failed,
        };
        let failure = Self::new(exit, error.to_string()).maybe_hint(error.hint());
        match error {
            ClientError::Refused(RpcError { code, message, data, .. }) => {
                let message = if code == Code::InvalidParams { without_params(message) } else { message };
                Self { what: message, code: code.name().to_owned(), data: data.map(Box::new), ..failure }
            }
            _ => failure,
        }
    }
}

/// Returns a text without the number of an error of the system, whose words are before it: ` (os error 2)`.
fn without_number(text: String) -> String {
    let Some((before, after)) = text.split_once(" (os error ") else { return text };
    after.split_once(')').map_or_else(|| text.clone(), |(_, after)| without_number(format!("{before}{after}")))
}

/// Returns the text about wrong parameters without the names of the rpc method and of its lists, which a user of the
/// command line did not type: `params of "plan": goals[0].pose.quat has length 0` → `pose.quat has length 0`.
fn without_params(message: String) -> String {
    let Some((_, what)) = message.strip_prefix("params of ").and_then(|rest| rest.split_once("\": ")) else {
        return message;
    };
    // The step of a `go`: `steps[0].plan.`
    let step = what.strip_prefix("steps[").and_then(|rest| rest.splitn(3, '.').nth(2));
    step.unwrap_or(what).replace("goals[0].", "")
}

/// Returns the exit code of a refusal: a name that the run does not know and a mistake in the arguments are usage
/// errors, everything else is a failure.
fn exit_of(code: Code) -> Exit {
    match code {
        Code::UnknownArm
        | Code::UnknownTask
        | Code::UnknownRobot
        | Code::UnknownObject
        | Code::UnknownPlan
        | Code::UnknownMotion
        | Code::InvalidParams
        | Code::InvalidTrajectory => Exit::Usage,
        Code::Unreachable => Exit::Hardware,
        _ => Exit::Failed,
    }
}

#[cfg(test)]
mod tests {
    use anyhow::Context;

    use super::*;

    #[test]
    fn every_exit_code_is_in_the_list_once() {
        let codes: Vec<u8> = Exit::ALL.iter().map(|(exit, _)| *exit as u8).collect();
        assert_eq!(codes, [0, 1, 2, 3, 4, 5, 130, 143]);
        assert_eq!((Exit::of(5), Exit::of(101)), (Exit::Log, Exit::Failed));
    }

    #[test]
    fn unknown_names_are_usage_errors_and_refusals_are_failures() {
        use Code::*;
        let exit = |code| Failure::from(ClientError::Refused(RpcError::new(code, "what"))).exit;
        for unknown in [UnknownArm, UnknownTask, UnknownRobot, UnknownObject, UnknownPlan, InvalidParams] {
            assert_eq!(exit(unknown), Exit::Usage, "{unknown:?}");
        }
        for refused in [ArmLatched, LeaseHeld, NoPlanner, OutOfLimits, PlanOutdated, DeviceRefused] {
            assert_eq!(exit(refused), Exit::Failed, "{refused:?}");
        }
    }

    #[test]
    fn a_refusal_as_json_has_code_message_hint_and_data() {
        let refusal =
            RpcError::new(Code::InvalidParams, "params of \"plan\": goals[0].pose.quat has length 0, must be 1");
        let failure = Failure::from(ClientError::Refused(RpcError { data: Some(json!({"at": 3})), ..refusal }));
        let error = json!({"code": "INVALID_PARAMS", "message": "pose.quat has length 0, must be 1", "hint": null,
            "data": {"at": 3}});
        assert_eq!(failure.to_json(), json!({"error": error}));
        let own = Failure::usage("no such arm").hint("there is `left`").to_json();
        let error = json!({"code": "USAGE", "message": "no such arm", "hint": "there is `left`", "data": null});
        assert_eq!(own, json!({"error": error}));
    }

    #[test]
    fn an_error_of_the_system_has_its_context_and_a_failure_stays_what_it_is() {
        let denied = || std::io::Error::from(std::io::ErrorKind::PermissionDenied);
        let failure: Failure = Err::<(), _>(denied()).context("plan.json").unwrap_err().into();
        assert_eq!(failure, Failure::new(Exit::Failed, "plan.json: permission denied"));
        let of_system = std::io::Error::from_raw_os_error(2);
        let what = format!("a.yaml: {of_system}; b.yaml: {of_system}");
        assert_eq!(Failure::usage(what).what, "a.yaml: No such file or directory; b.yaml: No such file or directory");
        let usage = Failure::usage("no such arm").hint("there is `left`");
        assert_eq!(Failure::from(anyhow::Error::from(usage.clone())), usage);
    }
}
