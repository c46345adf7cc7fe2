//! Reports of a run: the replies to `status`, `state` and `motion`. SI units; a field in another unit has it in its
//! name.

use std::collections::BTreeMap;

use nalgebra::Isometry3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::api::{IoReport, LoadReport, SpeedReport};
use crate::pose::{tcp_name, to_xyz_rpy};

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

/// One arm in `status`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct ArmReport {
    /// Its `hardware_id` in the blueprint.
    pub hardware_id: String,
    /// Its adapter's name.
    pub adapter: String,
    /// Address of its device.
    pub address: String,
    /// Whether it is an emulator, or an ideal arm in memory.
    pub simulated: bool,
    /// State of the connection: `down`, `up`, `stale`, `faulted`.
    pub link: String,
    /// Its phase: `unknown`, `disabled`, `activating`, `ready`, `held`, `standby`.
    pub phase: String,
    /// Why it is held; absent if it is not.
    pub cause: Option<CauseReport>,
    /// A stop that could not be sent; it is delivered after the reconnect.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub stop_pending: bool,
    /// Whether its motors are enabled.
    pub enabled: bool,
    /// Its control mode.
    pub mode: String,
    /// State and mode codes of the device, as in its manual; absent if it has none.
    #[serde(default)]
    pub device_state: Option<DeviceState>,
    /// Error of the device; absent without one.
    pub error: Option<DeviceError>,
    /// Age of its latest state [ms]; absent before the first.
    pub state_age_ms: Option<f64>,
    /// Measured rate of new states [Hz].
    pub measured_rate_hz: Option<f64>,
    /// Nominal rate of new states [Hz].
    pub native_rate_hz: f64,
    /// Recent faults, the newest last.
    pub faults: Vec<FaultReport>,
    /// Holder of its lease; absent without one.
    #[serde(default)]
    pub commander: Option<CommanderReport>,
    /// Closed and open position of its gripper [`gripper_unit`]; absent without a gripper, or if the adapter does not
    /// report it.
    #[serde(default)]
    pub gripper_range: Option<[f64; 2]>,
    /// Unit of its gripper's position: `m` of opening, or `rad` of a rotary jaw; absent without a gripper.
    #[serde(default)]
    pub gripper_unit: Option<String>,
    /// Smallest and largest force of a gripper command [`gripper_force_unit`]; absent without force control.
    #[serde(default)]
    pub gripper_force_range: Option<[f64; 2]>,
    /// Whether commands of its gripper may have a speed.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub gripper_has_speed: bool,
    /// Unit of its gripper's force: `N`, `Nm` or `%`; absent without a gripper.
    #[serde(default)]
    pub gripper_force_unit: Option<String>,
    /// Measured force of its gripper [`gripper_force_unit`]; absent if it measures none.
    #[serde(default)]
    pub gripper_force: Option<f64>,
    /// Its digital and analogue inputs and outputs, as read last; absent without any.
    #[serde(default)]
    pub io: Option<IoReport>,
    /// Condition of its joints, as read last; empty if the device reports none.
    #[serde(default)]
    pub joints: Vec<JointStatusReport>,
    /// The load at the flange that its controller reports, or that was set; absent if it takes none.
    #[serde(default)]
    pub payload: Option<LoadReport>,
    /// The point whose pose `state` reports and pose goals are for; absent if the run has no model of the arm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tcp: Option<TcpReport>,
    /// Lower and upper position limits of its joints [rad], in their order.
    #[serde(default)]
    pub position_limits: Vec<[f64; 2]>,
    /// Behaviour at the end of the run: `hold` or `disable`.
    pub on_exit: String,
    /// Whether it keeps its pose when its motors are disabled; otherwise it falls.
    pub holds_when_disabled: bool,
    /// Counters of the device thread: `reads`, `read_errors`, `writes`, …
    pub counters: BTreeMap<String, u64>,
}

/// Condition of one joint in `status`; null: the device does not report it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct JointStatusReport {
    /// Its name.
    pub name: String,
    /// Temperature of the motor or its driver [°C].
    pub temperature: Option<f64>,
    /// Motor current [A].
    pub current: Option<f64>,
    /// Supply voltage [V].
    pub voltage: Option<f64>,
    /// Load as a fraction of the rated torque, signed.
    pub load: Option<f64>,
    /// Error code of the drive; 0 = none.
    pub error: Option<i32>,
    /// Offset that the device's calibration subtracts from its encoder [rad].
    pub calibration_offset: Option<f64>,
}

/// The lease holder of an arm.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct CommanderReport {
    /// Process id; absent if the system does not report it.
    pub pid: Option<i32>,
    /// Name of the program: `python3 policy.py`.
    pub program: String,
    /// Time since it took the lease [s].
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

/// State and mode codes of a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct DeviceState {
    /// State code.
    pub state: i32,
    /// Mode code.
    pub mode: i32,
}

/// Error of a device.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct DeviceError {
    /// Error code of the device.
    pub code: i32,
    /// What it means.
    pub text: String,
}

/// A fault of an arm; repeated occurrences count as one.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct FaultReport {
    /// Time since it began [s].
    pub since: f64,
    /// Whether it is over.
    pub over: bool,
    /// Number of occurrences.
    pub count: u64,
    /// Description.
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
    /// The methods that send it targets: `execute`, `servo`, `velocity`, `pose`, `twist`; `start`: it takes none.
    #[serde(default)]
    pub takes: Vec<String>,
    /// Joints that it may claim.
    pub joints: Vec<String>,
    /// Its priority; the highest wins.
    pub priority: i32,
    /// Its state: `IDLE`, `EXECUTING`, …
    pub state: String,
    /// Progress 0–1, if the task has an end.
    pub progress: Option<f64>,
    /// Reason for its state, if any.
    pub reason: Option<String>,
    /// Number of its current or latest motion.
    pub motion: Option<u64>,
    /// What currently limits its motion, where the task knows.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bound: Option<String>,
    /// Largest distance of a joint from its leader's, while a `follow` task is active [rad].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub distance: Option<f64>,
    /// What was sent to a `chunk` task, and the gripper targets sent to any task; absent before the first.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stream: Option<StreamCounts>,
}

/// Counts of a task's chunks and gripper targets since the start of the run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct StreamCounts {
    /// Actions of chunks.
    pub actions: u64,
    /// Those that were dropped because their time was over.
    pub late_actions: u64,
    /// Gripper targets.
    pub gripper_targets: u64,
    /// Those that were dropped because their time was over.
    pub late_gripper_targets: u64,
}

impl TaskReport {
    /// Returns whether this method sends it targets.
    pub fn takes(&self, method: &str) -> bool {
        self.takes.iter().any(|taken| taken == method)
    }
}

/// Reply to `state`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct StateReport {
    /// Index of the tick.
    pub tick: u64,
    /// Wall-clock time of the tick [s since the Unix epoch].
    pub stamp: f64,
    /// The arms, in the blueprint's order.
    pub arms: Vec<ArmStateReport>,
}

/// One arm in `state`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct ArmStateReport {
    /// Its `hardware_id` in the blueprint.
    pub hardware_id: String,
    /// Whether an emulator replaces it.
    pub simulated: bool,
    /// Age of its latest state [ms]; absent before the first.
    pub age_ms: Option<f64>,
    /// Its joints, in order.
    pub joints: Vec<JointReport>,
    /// Gripper position [`gripper_unit`].
    pub gripper: Option<f64>,
    /// Unit of the gripper's position: `m` of opening, or `rad` of a rotary jaw; absent without a gripper.
    #[serde(default)]
    pub gripper_unit: Option<String>,
    /// Measured force of the gripper [`gripper_force_unit`]; absent if it measures none.
    #[serde(default)]
    pub gripper_force: Option<f64>,
    /// Unit of the gripper's force: `N`, `Nm` or `%`; absent without a gripper.
    #[serde(default)]
    pub gripper_force_unit: Option<String>,
    /// Pose of its tool centre point in `map`, computed from the measured joints; absent if the run has no model of it.
    pub pose: Option<PoseReport>,
    /// Pose that the device reports: its flange in its base; absent if it reports none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub device_pose: Option<PoseReport>,
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
    /// Source of the velocity: `measured`, `estimated`, `absent`.
    pub velocity_source: String,
    /// Torque [Nm]; absent if the arm does not report it.
    pub effort: Option<f64>,
    /// Commanded value [rad or rad/s, by the arm's mode].
    pub command: Option<f64>,
}

/// A pose: of what, in which frame.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct PoseReport {
    /// The link of the model; `flange` in a device's own pose.
    #[serde(default)]
    pub link: String,
    /// Tool on the link, whose centre point has the pose; absent: the link itself has it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tool: Option<ToolReport>,
    /// Reference frame: `map`, or `base` in a device's own pose.
    #[serde(default)]
    pub frame: String,
    /// x, y, z [m].
    pub xyz: [f64; 3],
    /// roll, pitch, yaw [rad], fixed axes.
    pub rpy: [f64; 3],
}

impl PoseReport {
    /// Returns whose pose it is, and in which frame: `link_tcp in map`.
    pub fn label(&self) -> String {
        format!("{} in {}", tcp_name(&self.link, self.tool.is_some()), self.frame)
    }
}

/// Pose of a tool centre point in the frame of its link.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct ToolReport {
    /// x, y, z [m].
    pub xyz: [f64; 3],
    /// roll, pitch, yaw [rad], fixed axes.
    pub rpy: [f64; 3],
}

impl From<&Isometry3<f64>> for ToolReport {
    fn from(tool: &Isometry3<f64>) -> Self {
        let (xyz, rpy) = to_xyz_rpy(tool);
        Self { xyz, rpy }
    }
}

/// The point whose pose is an arm's.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct TcpReport {
    /// The end-effector link of the model.
    pub link: String,
    /// The tool on it; absent: the point is the link's origin.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tool: Option<ToolReport>,
}

impl TcpReport {
    /// Returns the point's name: `link_tcp`, or `the tool on link_tcp`.
    pub fn name(&self) -> String {
        tcp_name(&self.link, self.tool.is_some())
    }
}

/// Reply to `motion`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct MotionReport {
    /// The motion's number.
    pub motion: u64,
    /// The task that executes it.
    pub task: String,
    /// The task's state in this motion: `EXECUTING`, `COMPLETED`, `ABORTED`, …
    pub state: String,
    /// Whether it has ended and the arm is at rest.
    pub done: bool,
    /// Progress 0–1.
    pub progress: f64,
    /// Time since its start [s].
    pub elapsed: f64,
    /// Time until its planned end [s], with the present speed override; of its whole speed while paused.
    pub remaining: f64,
    /// The speed override, if it slows the motion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub speed: Option<SpeedReport>,
    /// Why it did not reach its goal.
    pub error: Option<String>,
    /// Whether an obstacle blocked it and it is being replanned; meanwhile it is not done.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub replanning: bool,
    /// Number of the motion that continues it around the obstacle.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<u64>,
    /// Whether it executes a plan: a direct motion and a trajectory of a client are not collision-checked.
    #[serde(default)]
    pub collision_checked: bool,
    /// If it retraces the log: time in it of the goal [s since 1970].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub retraces_to: Option<f64>,
    /// When done: final error of each joint.
    pub deviation: Option<Vec<Deviation>>,
}

/// Final error of a joint.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Deviation {
    /// The joint.
    pub joint: String,
    /// Target position [rad].
    pub target: f64,
    /// Measured position [rad].
    pub actual: f64,
}

impl Deviation {
    /// Returns measured minus target position [rad].
    pub fn error(&self) -> f64 {
        self.actual - self.target
    }
}
