//! A blueprint as written. These doc comments become `docs/blueprint-reference.md` and the JSON Schema.

use std::fmt;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::value::MapAccessDeserializer;
use serde::de::{Deserializer, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Serialize};

use crate::blueprint::endpoints::MetricsConfig;
use crate::blueprint::limits::LimitsEntry;
use crate::blueprint::parts::{MountingEntry, PayloadEntry, StopInputEntry};
use crate::blueprint::peripherals::PeripheralEntry;
use crate::blueprint::planner::{PlannerEntry, ViewConfig};
use crate::blueprint::share::ShareEntry;
use crate::blueprint::size::Size;
use crate::blueprint::tick_clock::TickClock;
use dimos_control::config::FeedForward;
use dimos_yaml::range::{self, tick_rate};
use dimos_yaml::{Keyed, Located, Raw};

/// A blueprint: the arms, tasks, planner and log of a run.
#[derive(Debug, Clone, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
#[schemars(title = "dimos blueprint")]
pub struct BlueprintFile {
    /// Name of the blueprint. Default: the file's name.
    pub name: Option<Located<String>>,
    /// One line for `dimos list-blueprints`.
    pub description: String,
    /// Blueprints that this one builds on: names, or paths relative to this file. They are merged first; entries of
    /// `hardware`, `tasks` and `planner.robots` are matched by id, everything else is replaced key by key.
    pub include: Vec<Located<String>>,
    /// The control loop.
    pub coordinator: CoordinatorConfig,
    /// The arms.
    pub hardware: Vec<Located<HardwareEntry>>,
    /// The tasks: they command the arms' joints.
    pub tasks: Vec<Located<TaskEntry>>,
    /// Motion planning.
    pub planner: Option<Located<PlannerEntry>>,
    /// The collision guard of streams: servo, velocity, chunks, poses, twists, followers, jogging. Default: enabled if
    /// there is a planner.
    pub guard: Option<Located<GuardConfig>>,
    /// The live view in the browser.
    pub view: Option<Located<ViewConfig>>,
    /// The log of the run.
    pub recording: RecordingConfig,
    /// The socket for client programs.
    pub rpc: RpcConfig,
    /// Metrics of the run for Prometheus and others. Without this section there are none.
    pub metrics: Option<Located<MetricsConfig>>,
    /// The run on a network.
    pub share: Option<Located<ShareEntry>>,
    /// Files that are fetched on first use, by name: archives of robot descriptions, meshes, point clouds. Robots and
    /// obstacles refer to files and folders in them by `asset:NAME/path`; see `docs/models.md`.
    pub assets: Keyed<AssetEntry>,
}

/// The control loop.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct CoordinatorConfig {
    /// Rate of the control loop [Hz].
    #[serde(deserialize_with = "tick_rate")]
    #[schemars(range(min = 1.0, max = 2000.0))]
    pub tick_rate: f64,
    /// What starts a tick: `host`, this computer's clock, or `device(ARM)`: the states that this arm streams, one per
    /// cycle of its controller. Their rate is then `tick_rate` or a multiple of it. The other arms follow.
    pub clock: TickClock,
    /// Whether the joint state is published to clients.
    pub publish_joint_state: bool,
    /// `frame_id` of published joint states.
    pub joint_state_frame_id: String,
}

impl Default for CoordinatorConfig {
    fn default() -> Self {
        Self {
            tick_rate: 100.0,
            clock: TickClock::Host,
            publish_joint_state: true,
            joint_state_frame_id: "coordinator".to_owned(),
        }
    }
}

/// The collision guard: arms that follow streams decelerate to rest before they touch something in the planner's world,
/// another arm or themselves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct GuardConfig {
    /// Whether streams are guarded.
    pub enabled: bool,
    /// Distance that is kept from obstacles and other arms [m].
    #[serde(deserialize_with = "range::non_negative")]
    #[schemars(range(min = 0.0))]
    pub margin: f64,
}

impl Default for GuardConfig {
    fn default() -> Self {
        Self { enabled: true, margin: 0.01 }
    }
}

/// An arm.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct HardwareEntry {
    /// Unique name of the arm: letters, digits, `_` and `-`.
    pub hardware_id: Located<String>,
    /// Kind of hardware.
    #[serde(default)]
    pub hardware_type: HardwareType,
    /// The arm's joints, from the base: a list of names, or `{prefix: arm, count: 6}` for `arm_joint1` … `arm_joint6`.
    pub joints: Located<Joints>,
    /// The arm's adapter; see `dimos list-adapters`.
    pub adapter_type: Located<String>,
    /// Address of the arm, in the form that `dimos list-adapters` shows; `sim` starts the adapter's emulator.
    #[serde(default)]
    pub address: Option<Located<String>>,
    /// Whether the motors are enabled when the run starts.
    #[serde(default = "yes")]
    pub auto_enable: bool,
    /// What happens to the motors when the run ends. Default: `hold` if the arm drops when its motors are disabled,
    /// `disable` if it has brakes.
    #[serde(default)]
    pub on_exit: Option<OnExit>,
    /// With `on_exit: park`: where the arm goes at the end, one position per joint [rad]. The way there is direct, not
    /// collision-checked.
    #[serde(default)]
    #[schemars(with = "Option<Vec<f64>>")]
    pub park_pose: Option<Located<Vec<Located<f64>>>>,
    /// Maximum position error of a joint at rest under load [rad]. Default: the adapter's.
    #[serde(default, deserialize_with = "range::maybe_positive")]
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub accuracy: Option<f64>,
    /// Time from a setpoint to the measured motion that follows it [s]; `dimos adapter test --lag` measures it.
    /// Default: the adapter's.
    #[serde(default, deserialize_with = "range::maybe_lag")]
    #[schemars(extend("minimum" = 0, "maximum" = 1))]
    pub lag: Option<f64>,
    /// Max age of a state [s]: an arm without a newer state is held. The limit is never shorter than three device
    /// periods. Default: the adapter's; at least 0.25 for a simulated arm.
    #[serde(default, deserialize_with = "range::maybe_age")]
    #[schemars(extend("minimum" = 0.02, "maximum" = 2))]
    pub stale_after: Option<f64>,
    /// Maximum tracking error of a joint, compared with its setpoints of the last `lag` seconds [rad]: an arm that
    /// exceeds it for 100 ms is held. Default: 0.15.
    #[serde(default, deserialize_with = "range::maybe_positive")]
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub tracking_tolerance: Option<f64>,
    /// Whether a state with every joint at exactly zero is accepted even if the device does not confirm it.
    #[serde(default)]
    pub accept_zero_pose: bool,
    /// A digital input of the arm that stops it: while it is open, the arm is held. Default: none.
    #[serde(default)]
    pub stop_input: Option<StopInputEntry>,
    /// The load at the flange: set and read back before the motors are enabled. Default: the controller keeps its own
    /// setting.
    #[serde(default)]
    pub payload: Option<Located<PayloadEntry>>,
    /// How the base is mounted: set before the motors are enabled, so that the controller compensates gravity.
    /// Default: the controller keeps its own setting, from the factory upright.
    #[serde(default)]
    pub mounting: Option<Located<MountingEntry>>,
    /// Efforts that are computed in every tick and commanded with the positions, of an arm that takes them: `gravity`
    /// holds its weight, and with `payload` that of the load; `dynamics` also moves its masses. Not for an arm whose
    /// own controller compensates gravity.
    #[serde(default)]
    #[schemars(with = "FeedForward")]
    pub feed_forward: Option<Located<FeedForward>>,
    /// The `.urdf` or `.xacro` file, or `builtin:NAME`, with the masses of its links. Default: that of its robot in
    /// `planner`, of a Cartesian task with its joints, or the built-in one. `base_pose` of the planner or `mounting`
    /// gives the direction of gravity.
    #[serde(default)]
    pub model_path: Option<Located<String>>,
    /// A gripper with its own connection, such as a Robotiq. Default: the arm's own, if it has one.
    #[serde(default)]
    pub gripper: Option<Located<PeripheralEntry>>,
    /// A force/torque sensor with its own connection. Default: the arm's own, if it has one.
    #[serde(default)]
    pub force_torque: Option<Located<PeripheralEntry>>,
    /// The adapter's own options.
    #[serde(default)]
    #[schemars(with = "Option<serde_json::Map<String, serde_json::Value>>")]
    pub options: Option<Raw>,
    /// Limits narrower than the arm's own.
    #[serde(default)]
    pub limits: LimitsEntry,
}

fn yes() -> bool {
    true
}

/// Kind of hardware.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum HardwareType {
    /// An arm.
    #[default]
    Manipulator,
}

/// What happens to the motors when the run ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum OnExit {
    /// The motors stay enabled and hold the pose.
    Hold,
    /// The motors are disabled; the arm's brakes hold it.
    Disable,
    /// The arm moves to its `park_pose`, then the motors are disabled: at a controlled end (signal, `dimos down`,
    /// duration), never after a fault.
    Park,
}

impl OnExit {
    /// The name used in blueprints and tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Hold => "hold",
            Self::Disable => "disable",
            Self::Park => "park",
        }
    }
}

/// The joints of an arm.
#[derive(Debug, Clone)]
pub enum Joints {
    /// Their names.
    Names(Vec<Located<String>>),
    /// `prefix_joint1` … `prefix_jointN`.
    Counted(CountedJoints),
}

/// Joints named by a pattern.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CountedJoints {
    /// Prefix of the names: `arm` for `arm_joint1`.
    pub prefix: Located<String>,
    /// Number of joints.
    #[schemars(range(min = 1, max = 16))]
    pub count: Located<u64>,
}

impl<'de> Deserialize<'de> for Joints {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(JointsVisitor)
    }
}

/// A list or a group: `untagged` would lose the places.
struct JointsVisitor;

impl<'de> Visitor<'de> for JointsVisitor {
    type Value = Joints;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a list of joint names or {prefix: NAME, count: N}")
    }

    fn visit_unit<E>(self) -> Result<Joints, E> {
        Ok(Joints::Names(Vec::new()))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<Joints, A::Error> {
        let mut names = Vec::new();
        while let Some(name) = seq.next_element()? {
            names.push(name);
        }
        Ok(Joints::Names(names))
    }

    fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<Joints, A::Error> {
        CountedJoints::deserialize(MapAccessDeserializer::new(map)).map(Joints::Counted)
    }
}

impl JsonSchema for Joints {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "Joints".into()
    }

    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        let counted = generator.subschema_for::<CountedJoints>();
        json_schema!({
            "anyOf": [{ "type": "array", "items": { "type": "string" }, "minItems": 1, "maxItems": 16 }, counted]
        })
    }
}

/// A task: commands joints.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TaskEntry {
    /// Unique name of the task: letters, digits, `_` and `-`.
    pub name: Located<String>,
    /// Type of the task. The schema replaces this description by the table of task types.
    #[serde(rename = "type")]
    pub kind: Located<String>,
    /// The joints it commands: a list of names, or `{hardware: arm}` for all joints of an arm.
    pub joint_names: Located<JointNames>,
    /// Priority: if two tasks command the same joint, the higher number wins.
    #[serde(default = "default_priority")]
    pub priority: i32,
    /// Whether the task is started with the run.
    #[serde(default)]
    pub auto_start: bool,
    /// Parameters of the task type.
    #[serde(default)]
    #[schemars(with = "Option<serde_json::Map<String, serde_json::Value>>")]
    pub params: Option<Raw>,
}

fn default_priority() -> i32 {
    10
}

/// The joints of a task.
#[derive(Debug, Clone)]
pub enum JointNames {
    /// Their names.
    Names(Vec<Located<String>>),
    /// All joints of an arm.
    Hardware(HardwareJoints),
}

/// All joints of an arm.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct HardwareJoints {
    /// The arm's `hardware_id`.
    pub hardware: Located<String>,
}

impl<'de> Deserialize<'de> for JointNames {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(JointNamesVisitor)
    }
}

struct JointNamesVisitor;

impl<'de> Visitor<'de> for JointNamesVisitor {
    type Value = JointNames;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a list of joint names or {hardware: ID}")
    }

    fn visit_unit<E>(self) -> Result<JointNames, E> {
        Ok(JointNames::Names(Vec::new()))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<JointNames, A::Error> {
        let mut names = Vec::new();
        while let Some(name) = seq.next_element()? {
            names.push(name);
        }
        Ok(JointNames::Names(names))
    }

    fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<JointNames, A::Error> {
        HardwareJoints::deserialize(MapAccessDeserializer::new(map)).map(JointNames::Hardware)
    }
}

impl JsonSchema for JointNames {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "JointNames".into()
    }

    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        let hardware = generator.subschema_for::<HardwareJoints>();
        json_schema!({ "anyOf": [{ "type": "array", "items": { "type": "string" }, "minItems": 1 }, hardware] })
    }
}

/// The log of the run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RecordingConfig {
    /// Whether the run is recorded. `--no-record` turns it off.
    pub enabled: bool,
    /// Folder of the logs. Default: `$XDG_STATE_HOME/dimos`.
    pub directory: Option<String>,
    /// Number of logs to keep there, the newest ones; 0 = all.
    pub keep: u32,
    /// Minimum free space on the disk of the log, such as `200 MB`, or in bytes; 0 = no minimum. With less, a run does
    /// not start, and a live run ends with its log closed and complete.
    pub min_free: Size,
    /// Compression of the log. Without it a log is about four times as large.
    pub compression: Compression,
    /// Time between two syncs of the log to the disk [s], which is what a loss of power costs; 0 leaves it to the
    /// kernel: half a minute.
    #[serde(deserialize_with = "range::non_negative")]
    #[schemars(range(min = 0.0))]
    pub sync_every: f64,
    /// Size at which the log continues in another file, without attachments, such as `1 GB`; 0 = never. Less than 1 MB
    /// counts as 1 MB.
    pub split_size: Size,
    /// Length at which the log continues in another file [s]; 0 = never. Less than 1 s counts as
    /// 1 s.
    #[serde(deserialize_with = "range::non_negative")]
    #[schemars(range(min = 0.0))]
    pub split_after: f64,
    /// Whether a run that is not recorded logs its faults: the 30 s before, which it keeps in at most 64 MiB of memory,
    /// and the 5 s after.
    pub fault_log: bool,
}

/// Compression of a log.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Compression {
    /// zstd, its fastest level.
    #[default]
    Zstd,
    /// None.
    None,
}

impl Default for RecordingConfig {
    fn default() -> Self {
        Self {
            enabled: true,
            directory: None,
            keep: 20,
            min_free: Size(200_000_000),
            compression: Compression::Zstd,
            sync_every: 1.0,
            split_size: Size(0),
            split_after: 0.0,
            fault_log: true,
        }
    }
}

/// The socket for client programs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RpcConfig {
    /// Whether there is one. Without it `dimos status`, `move`, `stop` and all other verbs cannot reach the run.
    pub enabled: bool,
}

impl Default for RpcConfig {
    fn default() -> Self {
        Self { enabled: true }
    }
}

/// A file that is fetched on first use. A tar.gz, zip or wheel is unpacked.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AssetEntry {
    /// URL: `https://`, `http://`, or `file://` with an absolute path.
    pub url: Located<String>,
    /// SHA-256 of the file, 64 hexadecimal digits.
    pub sha256: Located<String>,
}
