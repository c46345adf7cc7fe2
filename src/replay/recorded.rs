//! The run of a log: its arms, its tasks, and the configuration of its coordinator.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use thiserror::Error;

use crate::control::config::{ArmConfig, CoordinatorConfig};
use crate::joint::MAX_DOF;
use crate::recording::replay::{LogInfo, LogReader, ReplayError, attachment};
use crate::telemetry::describe::{ArmNames, Names};

/// Name of the attachment with the coordinator's configuration.
pub const COORDINATOR: &str = "coordinator.json";

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
    /// Its contents are inconsistent.
    #[error("the log {path} cannot be replayed: {what}\nhint: another version of the program may have written it")]
    Unfit {
        /// The log.
        path: PathBuf,
        /// The problem.
        what: String,
    },
}

/// The run of a log.
#[derive(Debug, Clone)]
pub struct Recorded {
    /// The log.
    pub path: PathBuf,
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
        let info = LogReader::open(path)?.info().clone();
        let path = path.to_owned();
        let Some(json) = attachment(&path, COORDINATOR)? else { return Err(RecordedError::NoCoordinator { path }) };
        let read = serde_json::from_slice(&json).map_err(|e| format!("{COORDINATOR}: {e}"));
        let names = read.and_then(|config| Ok((names(&config, &info.metadata)?, config)));
        match names {
            Ok((names, config)) => Ok(Self { path, config, names, info }),
            Err(what) => Err(RecordedError::Unfit { path, what }),
        }
    }

    /// Returns the names of all joints, arm by arm.
    pub fn joints(&self) -> Vec<String> {
        self.names.arms.iter().flat_map(|arm| arm.joints.clone()).collect()
    }
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
