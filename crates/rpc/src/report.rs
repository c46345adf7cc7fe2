//! Reports of a run: the replies to `status`, `state` and `motion`. SI units; a field in another unit has it in its
//! name.

mod arm;
mod motion;
mod state;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::api::{GatewayReport, SpeedReport};

pub use arm::*;
pub use motion::*;
pub use state::*;

/// Reply to `status`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct StatusReport {
    /// Name of the run.
    pub run: String,
    /// Its process id.
    pub pid: u32,
    /// Version of the program.
    pub version: String,
    /// Name of the blueprint.
    pub blueprint: String,
    /// Start time, RFC 3339 in UTC.
    pub started: String,
    /// Time since the start [s].
    pub uptime: f64,
    /// Counts the stops, holds, disables, losses and changes of the lease of all arms.
    #[serde(default)]
    pub epoch: u64,
    /// Ticks per second [Hz].
    pub tick_rate: f64,
    /// Whether any of the arms is an emulator, or an ideal arm in memory.
    pub simulated: bool,
    /// Path of the log; absent without one.
    pub log: Option<String>,
    /// Requested real-time measures, and whether the system granted them.
    pub realtime: Vec<RealtimeReport>,
    /// Timing of the tick.
    pub ticks: TickReport,
    /// The recorder; absent without a log.
    pub recorder: Option<RecorderReport>,
    /// The arms, in the blueprint's order.
    pub arms: Vec<ArmReport>,
    /// The speed override.
    #[serde(default)]
    pub speed: SpeedReport,
    /// The tasks, in the blueprint's order.
    pub tasks: Vec<TaskReport>,
    /// The planner; absent without one.
    #[serde(default)]
    pub planner: Option<PlannerStatus>,
    /// Address of the live view, without its token; absent without one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub view: Option<String>,
    /// URL of the metrics; absent without any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub metrics: Option<String>,
    /// The gateway to other computers; absent without one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub share: Option<Box<GatewayReport>>,
}

impl StatusReport {
    /// Returns `SIMULATED` if all arms are, `PARTLY SIMULATED` if some are; empty if all are real.
    pub fn standing(&self) -> &'static str {
        match (self.simulated, self.arms.iter().all(|arm| arm.simulated)) {
            (false, _) => "",
            (true, true) => "SIMULATED",
            (true, false) => "PARTLY SIMULATED",
        }
    }
}

/// The planner in `status`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct PlannerStatus {
    /// `IDLE`, `PLANNING`, `EXECUTING`, `COMPLETED`, `FAULT`.
    pub state: String,
    /// Why it is in `FAULT`.
    pub error: Option<String>,
    /// The robots that it plans for.
    pub robots: Vec<String>,
    /// Its process; absent if it is part of the run.
    pub attached: Option<AttachedReport>,
}

/// A planner in its own process.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct AttachedReport {
    /// Its name.
    pub name: String,
    /// Process id; absent if the system does not report it.
    pub pid: Option<i32>,
}

/// One real-time measure.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct RealtimeReport {
    /// The measure: `real-time scheduling: SCHED_FIFO 80–82`.
    pub what: String,
    /// Whether the system granted it.
    pub granted: bool,
    /// How to get it, if it was not granted.
    pub remedy: Option<String>,
}

/// Timing of the tick since the run's start.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct TickReport {
    /// What starts them: `host`, or `device(ARM)`.
    #[serde(default)]
    pub clock: String,
    /// Number of ticks.
    pub count: u64,
    /// Ticks that began at least one period late.
    pub overruns: u64,
    /// Periods skipped after overruns.
    pub skipped: u64,
    /// Ticks that this computer's clock started because the arm that clocks them had sent no state.
    #[serde(default)]
    pub without_state: u64,
    /// Delay of the wake-up after the deadline; with an arm as the clock, after its state came [µs].
    pub lateness_us: Percentiles,
    /// Time from wake-up to the last command passed on [µs].
    pub compute_us: Percentiles,
}

/// Percentiles of a distribution.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Percentiles {
    /// Median.
    pub p50: f64,
    /// 99th percentile.
    pub p99: f64,
    /// 99.9th percentile.
    pub p99_9: f64,
    /// Maximum.
    pub max: f64,
}

/// The recorder.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct RecorderReport {
    /// Messages written.
    pub messages: u64,
    /// Samples lost because the ring was full.
    pub dropped: u64,
    /// Why it ended, if it did.
    pub error: Option<String>,
}
