//! What a run is started with, and how it ends.

use std::path::PathBuf;

use super::ServiceManager;
use dimos_control::tick_loop::Probe;
use dimos_planner::planning::request::planner_thread::Solver;
use dimos_rpc::api::TextLines;
use dimos_rpc::report::ArmReport;
use dimos_rpc::run_dir::RunDir;

/// Destination of the log.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Record {
    /// As set in the blueprint.
    #[default]
    AsBlueprint,
    /// This file.
    To(PathBuf),
    /// No log but those of faults, as set in the blueprint.
    Faults,
    /// No log at all.
    Off,
}

/// Options of a run besides its blueprint.
pub struct Options {
    /// Name of the run; default: the blueprint's.
    pub name: Option<String>,
    /// Destination of the log.
    pub record: Record,
    /// Run directory, for the socket.
    pub folder: RunDir,
    /// Called at the start of each tick, for tests and benchmarks.
    pub probe: Option<Probe>,
    /// Answers planning requests instead of the built-in planner.
    pub solver: Option<Solver>,
    /// Whether deep idle states of the processor are disabled.
    pub hold_latency: bool,
    /// Receives start, heartbeat and end of the run, e.g. systemd.
    pub service_manager: Option<ServiceManager>,
    /// Whether the live view is served, as the blueprint says.
    pub view: bool,
    /// The lines that the program prints, for clients that ask for its text log.
    pub text: Option<TextLines>,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            name: None,
            record: Record::AsBlueprint,
            folder: RunDir::standard(),
            probe: None,
            solver: None,
            hold_latency: true,
            service_manager: None,
            view: false,
            text: None,
        }
    }
}

/// Why a run did not start. Everything started before was stopped again.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// An arm cannot be reached, or differs from the blueprint.
    #[error("{arm}: {what}")]
    Hardware {
        /// The arm.
        arm: String,
        /// The problem.
        what: String,
        /// The hint.
        hint: String,
    },
    /// The blueprint has errors.
    #[error("{what}")]
    Blueprint {
        /// All of them as text, each with its location.
        what: String,
        /// The hint.
        hint: String,
    },
    /// Any other error.
    #[error("{what}")]
    Other {
        /// The problem.
        what: String,
        /// The hint.
        hint: String,
    },
}

impl StartError {
    /// Returns the hint.
    pub fn hint(&self) -> &str {
        match self {
            Self::Hardware { hint, .. } | Self::Blueprint { hint, .. } | Self::Other { hint, .. } => hint,
        }
    }

    pub(super) fn other(what: impl ToString, hint: impl ToString) -> Self {
        Self::Other { what: what.to_string(), hint: hint.to_string() }
    }
}

/// Why a run ends.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Ending {
    /// A signal, with its number.
    Signal(i32),
    /// The duration was reached.
    Duration,
    /// A shutdown request over rpc.
    Asked,
    /// The log ended, with the reason.
    Log(String),
    /// A fault.
    Fault(String),
}

/// Result of a run that has ended.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Ended {
    /// Problems during the shutdown.
    pub troubles: Vec<String>,
    /// The arms that were parked ([`Run::park_and_stop`]).
    pub parked: Vec<String>,
    /// The arms that were not released in order; [`troubles`](Self::troubles) say why.
    pub unreleased: Vec<String>,
    /// The arms at rest, before they were released.
    pub arms: Vec<ArmReport>,
    /// The log, if one was written.
    pub log: Option<PathBuf>,
    /// Why the log ended before the run, if so.
    pub log_cut: Option<String>,
    /// The logs of faults, if the run was not recorded.
    pub fault_logs: Vec<PathBuf>,
}
