//! How a verb ends: an exit code for scripts; what went wrong and what to do about it for people.

use crate::rpc::client::ClientError;
use crate::rpc::{Code, RpcError};

/// The exit codes: a contract, see `docs/`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Exit {
    /// Done.
    Ok = 0,
    /// Failed, refused, or not confirmed.
    Failed = 1,
    /// The command line, the blueprint or a file is wrong.
    Usage = 2,
    /// Hardware cannot be reached; for readers of logs: data lost or cut.
    Hardware = 3,
    /// A run ended by a fault.
    Fault = 4,
    /// A run ended because its log did: no room on the disk, or the log was removed.
    Log = 5,
    /// Ended by SIGINT, after the controlled stop.
    Interrupted = 130,
    /// Ended by SIGTERM, after the controlled stop.
    Terminated = 143,
}

impl Exit {
    /// The exit code of a number; one that is not in the contract (a crash) counts as failed.
    pub fn of(code: u8) -> Self {
        let all = [Self::Ok, Self::Usage, Self::Hardware, Self::Fault, Self::Log, Self::Interrupted, Self::Terminated];
        all.into_iter().find(|exit| *exit as u8 == code).unwrap_or(Self::Failed)
    }

    /// The code of a run or a wait that a signal ended.
    pub fn by_signal(signal: i32) -> Self {
        if signal == libc::SIGTERM { Self::Terminated } else { Self::Interrupted }
    }
}

/// Why a verb failed.
#[derive(Debug, Clone, PartialEq)]
pub struct Failure {
    /// The exit code.
    pub exit: Exit,
    /// What went wrong and where, in a sentence without full stop; further lines may show details.
    pub what: String,
    /// What to do about it.
    pub hint: Option<String>,
}

/// Result of a verb.
pub type Result<T = Exit> = std::result::Result<T, Failure>;

impl Failure {
    /// A failure without a hint.
    pub fn new(exit: Exit, what: impl Into<String>) -> Self {
        Self { exit, what: what.into(), hint: None }
    }

    /// Something is wrong with what was typed.
    pub fn usage(what: impl Into<String>) -> Self {
        Self::new(Exit::Usage, what)
    }

    /// The same with a hint.
    pub fn hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = Some(hint.into());
        self
    }
}

impl From<ClientError> for Failure {
    fn from(error: ClientError) -> Self {
        let exit = match &error {
            ClientError::SeveralRuns(_) | ClientError::UnknownRun { .. } => Exit::Usage,
            ClientError::Refused(refusal) => exit_of(refusal.code),
            _ => Exit::Failed,
        };
        let what = match &error {
            ClientError::Refused(RpcError { code, message, .. }) => format!("{message} [{}]", code.name()),
            _ => error.to_string(),
        };
        Self { exit, what, hint: error.hint() }
    }
}

/// What was typed wrong is a usage error, wherever it was noticed.
fn exit_of(code: Code) -> Exit {
    match code {
        Code::UnknownArm | Code::UnknownTask | Code::InvalidParams | Code::InvalidTrajectory => Exit::Usage,
        _ => Exit::Failed,
    }
}
