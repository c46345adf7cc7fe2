//! Reports of a run: the replies to `status`, `state` and `motion`. SI units; a field in another unit
//! says so in its name.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Reply to `status`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct StatusReport {
    /// Name of the run.
    pub run: String,
    /// Its process.
    pub pid: u32,
    /// Version of the program.
    pub version: String,
    /// Name of the blueprint.
    pub blueprint: String,
    /// When it started, RFC 3339 in UTC.
    pub started: String,
    /// How long it runs [s].
    pub uptime: f64,
    /// Ticks per second [Hz].
    pub tick_rate: f64,
    /// Whether an emulator replaces any of the arms.
    pub simulated: bool,
    /// The log that is being written; absent when there is none.
    pub log: Option<String>,
    /// What real-time measures were asked of the system, and what came of it.
    pub realtime: Vec<RealtimeReport>,
    /// Timing of the tick.
    pub ticks: TickReport,
    /// The recorder; absent when nothing is recorded.
    pub recorder: Option<RecorderReport>,
    /// The arms, in the blueprint's order.
    pub arms: Vec<ArmReport>,
    /// The tasks, in the blueprint's order.
    pub tasks: Vec<TaskReport>,
    /// The planner; absent where there is none.
    #[serde(default)]
    pub planner: Option<PlannerStatus>,
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
    /// The process that it attached from; absent where it is part of the run.
    pub attached: Option<AttachedReport>,
}

/// A planner in its own process.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct AttachedReport {
    /// What it is called.
    pub name: String,
    /// Its process; absent where the system does not tell.
    pub pid: Option<i32>,
}

/// One real-time measure.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct RealtimeReport {
    /// What was asked: `SCHED_FIFO 80 for the tick`.
    pub what: String,
    /// Whether the system granted it.
    pub granted: bool,
    /// How to get it, where it was not granted.
    pub remedy: Option<String>,
}

/// Timing of the tick since the run's start.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct TickReport {
    /// Ticks done.
    pub count: u64,
    /// Ticks that began a period or more too late.
    pub overruns: u64,
    /// Periods skipped by them.
    pub skipped: u64,
    /// Wake-up after the deadline [µs].
    pub lateness_us: Percentiles,
    /// Time from wake-up to the last command passed on [µs].
    pub compute_us: Percentiles,
}

/// A distribution.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Percentiles {
    /// Half of all values are below.
    pub p50: f64,
    /// 99 % are below.
    pub p99: f64,
    /// 99.9 % are below.
    pub p99_9: f64,
    /// The highest of all.
    pub max: f64,
}

/// The recorder.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct RecorderReport {
    /// Messages written.
    pub messages: u64,
    /// Samples lost because the ring was full.
    pub dropped: u64,
    /// Why it ended, where it did.
    pub error: Option<String>,
}

/// One arm in `status`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct ArmReport {
    /// Its name in the blueprint.
    pub hardware_id: String,
    /// Its adapter's name.
    pub adapter: String,
    /// Where its device is.
    pub address: String,
    /// Whether an emulator replaces it.
    pub simulated: bool,
    /// State of the connection: `down`, `up`, `stale`, `faulted`.
    pub link: String,
    /// What it is ready for: `unknown`, `disabled`, `activating`, `ready`, `held`, `standby`.
    pub phase: String,
    /// Why it is held; absent when it is not.
    pub cause: Option<CauseReport>,
    /// A stop was asked for while the arm could not be reached, and is delivered when it can.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub stop_pending: bool,
    /// Whether its motors are enabled.
    pub enabled: bool,
    /// The control mode it is in.
    pub mode: String,
    /// The device's own state and mode codes, as its manual has them; absent where it has none.
    #[serde(default)]
    pub device_state: Option<DeviceState>,
    /// The device's error; absent when there is none.
    pub error: Option<DeviceError>,
    /// Age of its latest state [ms]; absent before the first.
    pub state_age_ms: Option<f64>,
    /// How often its states come [Hz].
    pub measured_rate_hz: Option<f64>,
    /// How often they should [Hz].
    pub native_rate_hz: f64,
    /// Recent episodes of trouble, the newest last.
    pub faults: Vec<FaultReport>,
    /// Lease holder, which may move it; absent without one.
    #[serde(default)]
    pub commander: Option<CommanderReport>,
    /// How far its gripper closes and opens [m]; absent without a gripper, or where its adapter does not say.
    #[serde(default)]
    pub gripper_range: Option<[f64; 2]>,
    /// How far its joints go: lowest and highest position [rad], in their order.
    #[serde(default)]
    pub position_limits: Vec<[f64; 2]>,
    /// What happens to it when the run ends: `hold` or `disable`.
    pub on_exit: String,
    /// Whether it keeps its pose when its motors are disabled, or falls.
    pub holds_when_disabled: bool,
    /// What the device thread counted: `reads`, `read_errors`, `writes`, …
    pub counters: BTreeMap<String, u64>,
}

/// Who commands an arm.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct CommanderReport {
    /// Its process; absent where the system does not tell.
    pub pid: Option<i32>,
    /// What the process calls itself: `python3 policy.py`.
    pub program: String,
    /// For how long it holds the lease [s].
    pub held_for: f64,
}

/// Why an arm is held.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct CauseReport {
    /// For programs: `operator_stop`.
    pub name: String,
    /// For people.
    pub text: String,
}

/// A device's own codes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct DeviceState {
    /// Its state.
    pub state: i32,
    /// Its mode.
    pub mode: i32,
}

/// A device's own error.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct DeviceError {
    /// The device's code.
    pub code: i32,
    /// What it means.
    pub text: String,
}

/// An episode of trouble with an arm.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct FaultReport {
    /// How long ago it began [s].
    pub since: f64,
    /// Whether it is over.
    pub over: bool,
    /// How often it was seen.
    pub count: u64,
    /// What it is.
    pub text: String,
}

/// One task in `status`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct TaskReport {
    /// Its name.
    pub name: String,
    /// Its type, as in the blueprint.
    #[serde(rename = "type")]
    pub kind: String,
    /// The methods that send it targets: `execute`, `servo`, `velocity`, `pose`, `twist`.
    #[serde(default)]
    pub takes: Vec<String>,
    /// The joints that it may claim.
    pub joints: Vec<String>,
    /// Its priority; the higher wins.
    pub priority: i32,
    /// Its state: `IDLE`, `EXECUTING`, …
    pub state: String,
    /// How far it is, 0–1, where it has an end.
    pub progress: Option<f64>,
    /// Why it is in its state, where there is a reason.
    pub reason: Option<String>,
    /// The motion it carries out, or carried out last.
    pub motion: Option<u64>,
    /// What holds its end effector back just now.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bound: Option<String>,
}

impl TaskReport {
    /// Whether this method sends it targets.
    pub fn takes(&self, method: &str) -> bool {
        self.takes.iter().any(|taken| taken == method)
    }
}

/// Reply to `state`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct StateReport {
    /// Index of the tick.
    pub tick: u64,
    /// When it was, by the wall clock [s since the Unix epoch].
    pub stamp: f64,
    /// The arms, in the blueprint's order.
    pub arms: Vec<ArmStateReport>,
}

/// One arm in `state`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct ArmStateReport {
    /// Its name in the blueprint.
    pub hardware_id: String,
    /// Whether an emulator replaces it.
    pub simulated: bool,
    /// Age of its latest state [ms]; absent before the first.
    pub age_ms: Option<f64>,
    /// Its joints, in order.
    pub joints: Vec<JointReport>,
    /// Gripper opening [m].
    pub gripper: Option<f64>,
    /// End-effector pose in the arm's base frame.
    pub pose: Option<PoseReport>,
    /// Force and torque [N, N, N, Nm, Nm, Nm].
    pub wrench: Option<[f64; 6]>,
}

/// One joint in `state`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct JointReport {
    /// Its name.
    pub name: String,
    /// Position [rad]; absent before the first state.
    pub position: Option<f64>,
    /// Velocity [rad/s].
    pub velocity: Option<f64>,
    /// Where the velocity comes from: `measured`, `estimated`, `absent`.
    pub velocity_source: String,
    /// Torque [Nm], where the arm reports it.
    pub effort: Option<f64>,
    /// What is commanded [rad or rad/s, by the arm's mode].
    pub command: Option<f64>,
}

/// An end-effector pose in the arm's base frame.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct PoseReport {
    /// x, y, z [m].
    pub xyz: [f64; 3],
    /// roll, pitch, yaw [rad], fixed axes.
    pub rpy: [f64; 3],
}

/// Reply to `motion`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct MotionReport {
    /// The motion's number.
    pub motion: u64,
    /// The task that carries it out.
    pub task: String,
    /// The task's state in this motion: `EXECUTING`, `COMPLETED`, `ABORTED`, …
    pub state: String,
    /// Whether it is over: the arm is where it ended.
    pub done: bool,
    /// How far it is, 0–1.
    pub progress: f64,
    /// Time since its start [s].
    pub elapsed: f64,
    /// Time to its planned end [s].
    pub remaining: f64,
    /// Why it ended elsewhere than it should, in a sentence.
    pub error: Option<String>,
    /// Whether it had to end before something in its way, and is being planned again; until then it is not done.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub replanning: bool,
    /// The motion that continues in its place, around the obstacle.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<u64>,
    /// When done: how far off each joint ended.
    pub deviation: Option<Vec<Deviation>>,
}

/// How far off a joint ended.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Deviation {
    /// The joint.
    pub joint: String,
    /// Where it should be [rad].
    pub target: f64,
    /// Where it is [rad].
    pub actual: f64,
}

impl Deviation {
    /// By how much it missed [rad].
    pub fn error(&self) -> f64 {
        self.actual - self.target
    }
}
