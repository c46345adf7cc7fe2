//! The run of a log: its arms, its tasks, and the configuration of its coordinator.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use thiserror::Error;

use dimos_control::config::{ArmConfig, CONFIG_VERSION, CoordinatorConfig, FIRST_CONFIG_VERSION};
use dimos_core::joint::MAX_DOF;
use dimos_core::telemetry::describe::{ArmNames, Names};
use dimos_log::replay::{LogInfo, LogReader, ReplayError, attachment};
use dimos_log::rewrite::PART_OF;
use dimos_log::{CONFIG_VERSION_KEY, COORDINATOR};

/// Why a log cannot be replayed.
#[derive(Debug, Error)]
pub enum RecordedError {
    /// It cannot be read.
    #[error(transparent)]
    Replay(#[from] ReplayError),
    /// It lacks the coordinator's configuration.
    #[error(
        "the log {path} has no {COORDINATOR}: the configuration of its coordinator is unknown\n\
         hint: only logs written by `dimos run` can be replayed; `dimos replay` without --verify or --onto plays any log"
    )]
    NoCoordinator {
        /// The log.
        path: PathBuf,
    },
    /// The coordinator's configuration is damaged.
    #[error(
        "the log {path} cannot be replayed: its {COORDINATOR} is damaged (byte {at})\nhint: `dimos log doctor` checks all of it"
    )]
    Damaged {
        /// The log.
        path: PathBuf,
        /// Where the attachment is in its file [bytes].
        at: u64,
    },
    /// A part of it is missing or wrong: a motion of it would be half of one.
    #[error(
        "{path}: a part of the motion is missing or wrong: {loss}; nothing has moved\n\
         hint: choose a part before with --duration, or save one: dimos log cut {path} --to TIME -o part.mcap"
    )]
    Lacks {
        /// The log.
        path: PathBuf,
        /// What it lacks.
        loss: String,
    },
    /// Another version of the program wrote it: the same inputs give other commands now, or its configuration has
    /// another form.
    #[error(
        "the log {path} was written by {writer} with config version {found}; this program (dimos {}) verifies config \
         version {CONFIG_VERSION}{}\nhint: verify it with the program that wrote it; `dimos replay` without --verify plays it",
        crate::VERSION,
        changed_since(*found)
    )]
    Version {
        /// The log.
        path: PathBuf,
        /// Its config version.
        found: u32,
        /// The program that wrote it.
        writer: String,
    },
    /// It is a part of a log: what the coordinator did before is unknown.
    #[error(
        "the log {path} is a part of {whole}: it cannot be verified alone\nhint: only a log from its beginning can be verified: verify the whole log"
    )]
    Part {
        /// The log.
        path: PathBuf,
        /// The log that it was cut out of.
        whole: String,
    },
    /// A changed value does not fit.
    #[error("the change does not fit: {what}")]
    Change {
        /// The problem.
        what: String,
    },
    /// Its contents are inconsistent.
    #[error(
        "the log {path} cannot be replayed: {what}\nhint: the log was modified, or a program with other task types wrote it"
    )]
    Unfit {
        /// The log.
        path: PathBuf,
        /// The problem.
        what: String,
    },
}

impl RecordedError {
    /// Returns an error if the selection of a log that was read lacks anything.
    pub(super) fn unless_whole(path: &Path, log: &LogReader) -> Result<(), Self> {
        log.loss().text().map_or(Ok(()), |loss| Err(Self::Lacks { path: path.to_owned(), loss }))
    }
}

/// The run of a log.
#[derive(Debug, Clone)]
pub struct Recorded {
    /// The log.
    pub path: PathBuf,
    /// Config version of the program that wrote it.
    pub version: u32,
    /// Configuration of its coordinator.
    pub config: CoordinatorConfig,
    /// Names of arms, joints and tasks, in the order of the coordinator's indices.
    pub names: Names,
    /// Metadata of the log.
    pub info: LogInfo,
}

impl Recorded {
    /// Reads the run of a log.
    pub fn open(path: &Path) -> Result<Self, RecordedError> {
        Self::of(path, LogReader::open(path)?.info().clone())
    }

    /// Reads the run of a log that was opened already.
    pub fn of(path: &Path, info: LogInfo) -> Result<Self, RecordedError> {
        let path = path.to_owned();
        let damaged = |e| match e {
            ReplayError::Damaged { damage } => RecordedError::Damaged { path: path.clone(), at: damage.at },
            e => e.into(),
        };
        let Some(json) = attachment(&path, COORDINATOR).map_err(damaged)? else {
            return Err(RecordedError::NoCoordinator { path });
        };
        let version = config_version(&info.metadata, &json);
        let read = serde_json::from_slice(&json).map_err(|e| format!("{COORDINATOR}: {e}"));
        let names = read.and_then(|config| Ok((names(&config, &info.metadata)?, config)));
        match names {
            Ok((names, config)) => Ok(Self { path, version, config, names, info }),
            // A newer version may have changed the form of the configuration.
            Err(_) if version > CONFIG_VERSION => Err(version_error(path, version, &info)),
            Err(what) => Err(RecordedError::Unfit { path, what }),
        }
    }

    /// Rejects a part of a log, and a log whose config version differs from this program's: their ticks cannot be
    /// recomputed bit for bit.
    pub fn check_version(&self) -> Result<(), RecordedError> {
        if let Some(whole) = self.info.metadata.get(PART_OF) {
            return Err(RecordedError::Part { path: self.path.clone(), whole: whole.clone() });
        }
        if self.version == CONFIG_VERSION {
            return Ok(());
        }
        Err(version_error(self.path.clone(), self.version, &self.info))
    }

    /// Checks another configuration for the run.
    ///
    /// # Errors
    /// A description of what does not fit.
    pub fn check(&self, config: &CoordinatorConfig) -> Result<(), String> {
        names(config, &self.info.metadata).map(drop)
    }

    /// Returns the names of all joints, arm by arm.
    pub fn joints(&self) -> Vec<String> {
        self.names.arms.iter().flat_map(|arm| arm.joints.clone()).collect()
    }
}

/// Returns the config version of a log: from its metadata, in earlier logs from the configuration.
fn config_version(metadata: &BTreeMap<String, String>, json: &[u8]) -> u32 {
    #[derive(Deserialize)]
    struct Versioned {
        version: Option<u32>,
    }
    let in_configuration = || serde_json::from_slice::<Versioned>(json).ok()?.version;
    let version = metadata.get(CONFIG_VERSION_KEY).and_then(|version| version.parse().ok());
    version.or_else(in_configuration).unwrap_or(FIRST_CONFIG_VERSION)
}

/// Rules of the tick that have changed after a config version.
const CHANGED: [(u32, &str); 2] = [
    (6, "a task with auto_start does not start after a stop, a hold or a loss, and a reset needs no accepted state"),
    (8, "sine, logarithm and the like are those of the crate libm, no longer of the C library"),
];

/// Returns the rules of the tick that have changed since a config version, as part of a sentence.
fn changed_since(version: u32) -> String {
    let is_since = |(before, _): &&(u32, &str)| (CHANGED[0].0..=*before).contains(&version);
    let rules: Vec<&str> = CHANGED.iter().filter(is_since).map(|(_, rule)| *rule).collect();
    if rules.is_empty() { String::new() } else { format!("; changed since: {}", rules.join("; ")) }
}

fn version_error(path: PathBuf, found: u32, info: &LogInfo) -> RecordedError {
    let writer = info.metadata.get("dimos_version").map_or("another program".into(), |v| format!("dimos {v}"));
    RecordedError::Version { path, found, writer }
}

fn names(config: &CoordinatorConfig, metadata: &BTreeMap<String, String>) -> Result<Names, String> {
    if !(0.1..=1e5).contains(&config.rate) {
        return Err(format!("the tick rate is {} Hz", config.rate));
    }
    let joints: BTreeMap<String, Vec<String>> = metadata
        .get("arms")
        .and_then(|text| serde_json::from_str(text).ok())
        .ok_or("the metadata does not name the joints")?;
    let mut arms = Vec::new();
    for arm in &config.arms {
        check_limits(arm)?;
        let joints = joints.get(&arm.name).filter(|j| j.len() == arm.dof);
        let joints =
            joints.ok_or_else(|| format!("the metadata does not name the {} joints of {}", arm.dof, arm.name))?;
        arms.push(ArmNames { hardware_id: arm.name.clone(), joints: joints.clone() });
    }
    let all: usize = config.arms.iter().map(|a| a.dof).sum();
    if let Some(task) = config.tasks.iter().find(|t| t.joints.iter().any(|&j| usize::from(j) >= all)) {
        return Err(format!("task {} has joints that do not exist", task.name));
    }
    Ok(Names { arms, tasks: config.tasks.iter().map(|t| t.name.clone()).collect() })
}

/// A file may contain anything; the coordinator relies on limits that leave room to move.
fn check_limits(arm: &ArmConfig) -> Result<(), String> {
    let l = &arm.limits;
    let lists = [&l.position_lower, &l.position_upper, &l.velocity_max, &l.acceleration_max];
    let whole =
        arm.dof <= MAX_DOF && lists.iter().all(|list| list.len() == arm.dof && list.iter().all(|v| v.is_finite()));
    let room = || l.position_lower.iter().zip(&l.position_upper).all(|(lower, upper)| lower < upper);
    let speed = || l.velocity_max.iter().chain(&l.acceleration_max).all(|v| *v > 0.0);
    if whole && room() && speed() { Ok(()) } else { Err(format!("the limits of {} leave no room to move", arm.name)) }
}
