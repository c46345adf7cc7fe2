//! What a run can be asked: the table of methods, their parameters and replies, and [`Backend`], which answers.
//!
//! Everything is in SI units (rad, rad/s, Nm, m, N, s); a field in another unit says so in its name (`age_ms`).

use std::collections::BTreeMap;
use std::future::Future;
use std::pin::Pin;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::error::{Code, RpcError};
use super::report::{MotionReport, StateReport, StatusReport};
use super::streams::Streams;
use crate::joint::MAX_DOF;

/// Longest request line, newline included [bytes].
pub const MAX_LINE: usize = 256 * 1024;
/// Most connections to one run.
pub const MAX_CONNECTIONS: usize = 64;
/// Most subscriptions of one connection.
pub const MAX_SUBSCRIPTIONS: usize = 16;
/// Lowest `speed` of a move, as a fraction of the arm's limits.
pub const MIN_SPEED: f64 = 0.1;

/// A boxed future, as trait objects need it.
pub type BoxFuture<'a, T> = Pin<Box<dyn Future<Output = T> + Send + 'a>>;

/// What stands behind the server: the run itself.
pub trait Backend: Send + Sync + 'static {
    /// Answers one request. Called from the server's thread, so it may wait but must not block; when it takes
    /// longer than [`server::CALL_LIMIT`](super::server::CALL_LIMIT) it is dropped.
    fn call(&self, request: Request) -> BoxFuture<'_, Result<Reply, RpcError>>;
    /// What the run publishes.
    fn streams(&self) -> &Streams;
}

/// The parameters of a method, which know the method's name and reply.
pub trait Method: Serialize + DeserializeOwned {
    /// The method's name.
    const NAME: &'static str;
    /// What comes back.
    type Reply: Serialize + DeserializeOwned;
    /// Says what is wrong with the values, in a sentence without full stop.
    fn check(&self) -> Result<(), String> {
        Ok(())
    }
}

/// One row per method: name, parameters, reply. Makes [`Request`], [`Reply`], [`METHODS`].
macro_rules! methods {
    ($($(#[$doc:meta])* $name:literal $variant:ident -> $reply:ty $(, check $check:path)?;)*) => {
        /// A request that a run answers.
        #[derive(Debug, Clone, PartialEq)]
        pub enum Request { $($(#[$doc])* $variant($variant),)* }

        /// What comes back: the variant of the same name.
        #[derive(Debug, Clone, PartialEq, Serialize)]
        #[serde(untagged)]
        #[expect(clippy::large_enum_variant, reason = "a reply is moved a few times and never kept")]
        pub enum Reply { $($(#[$doc])* $variant($reply),)* }

        /// Names of all methods, those that the connection itself answers at the end.
        pub const METHODS: &[&str] = &[$($name,)* "subscribe", "unsubscribe"];

        $(impl Method for $variant {
            const NAME: &'static str = $name;
            type Reply = $reply;
            $(fn check(&self) -> Result<(), String> { $check(self) })?
        })*

        impl Request {
            /// Reads the parameters of a method; refuses unknown methods, unknown or ill-formed parameters.
            pub fn read(method: &str, params: Value) -> Result<Self, RpcError> {
                match method {
                    $($name => read_params::<$variant>(params).map(Self::$variant),)*
                    _ => Err(RpcError::unknown(Code::UnknownMethod, "method", method, METHODS)),
                }
            }
        }
    };
}

methods! {
    /// Everything about the run: arms, tasks, timing, recorder.
    "status" Status -> StatusReport;
    /// The latest joint states and commands.
    "state" State -> StateReport;
    /// Moves an arm from where it is to a joint target, directly: not collision-checked. Answers when the motion
    /// begins; `motion` tells how it goes.
    "move" Move -> MoveReply, check Move::valid;
    /// Follows a trajectory. Answers when the motion begins.
    "execute" Execute -> ExecuteReply, check Execute::valid;
    /// How a motion goes, or how it ended.
    "motion" Motion -> MotionReport;
    /// Ends motions by decelerating within limits: those of a task, of an arm, or all.
    "cancel" Cancel -> CancelReply;
    /// Latched hold at once, of one arm or of all: tasks cancelled, arms held until `arm_reset`. An operational stop.
    "stop" Stop -> StopReply;
    /// Clears a latched hold or a fault. Moves nothing, enables nothing.
    "arm_reset" ArmReset -> ArmReply;
    /// Enables the motors and makes the arm ready for motion, where it is.
    "arm_enable" ArmEnable -> ArmReply;
    /// Disables the motors. An arm without brakes falls.
    "arm_disable" ArmDisable -> ArmReply;
    /// Commands a gripper.
    "gripper" Gripper -> Done, check Gripper::valid;
    /// Next target of a servo task; repeat it within the task's timeout.
    "servo" Servo -> Done, check Servo::valid;
    /// Next target of a velocity task; repeat it within the task's timeout.
    "velocity" Velocity -> Done, check Velocity::valid;
    /// Ends the run exactly like SIGTERM: controlled. Answers before it begins.
    "shutdown" Shutdown -> Done;
}

/// Reads and checks the parameters of one method; absent ones stand for `{}`.
pub(super) fn read_params<M: Method>(params: Value) -> Result<M, RpcError> {
    let params = if params.is_null() { Value::Object(Default::default()) } else { params };
    let invalid = |what: String| RpcError::new(Code::InvalidParams, format!("params of {:?}: {what}", M::NAME));
    let params: M = serde_json::from_value(params).map_err(|e| invalid(e.to_string()))?;
    params.check().map_err(invalid)?;
    Ok(params)
}

/// Parameters of `status`: none.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Status {}

/// Parameters of `state`: none.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct State {}

/// Parameters of `shutdown`: none.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Shutdown {}

/// Done; nothing to tell.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Done {}

/// Parameters of `move`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Move {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// Where its joints shall go [rad], one value per joint of the arm.
    pub target: Vec<f64>,
    /// Fraction of the velocity and acceleration limits to use, 0.1–1.
    #[serde(default = "default_speed")]
    pub speed: f64,
}

/// Fraction of the limits that a move uses when none is given.
pub const DEFAULT_SPEED: f64 = 0.5;

fn default_speed() -> f64 {
    DEFAULT_SPEED
}

impl Move {
    fn valid(&self) -> Result<(), String> {
        values("target", &self.target)?;
        if !(MIN_SPEED..=1.0).contains(&self.speed) {
            return Err(format!("speed is {}, and must be within {MIN_SPEED}–1", self.speed));
        }
        Ok(())
    }
}

/// A motion that began with `move`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MoveReply {
    /// The motion's number, for `motion`.
    pub motion: u64,
    /// The task that carries it out.
    pub task: String,
    /// How long it is planned to take [s].
    pub duration: f64,
    /// Names of the joints, in the order of the values.
    pub joints: Vec<String>,
    /// Where it starts [rad].
    pub start: Vec<f64>,
    /// Where it goes [rad].
    pub target: Vec<f64>,
}

/// Parameters of `execute`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Execute {
    /// What to follow.
    pub trajectory: Trajectory,
    /// The trajectory task to use; without it the one whose joints cover the trajectory's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub task: Option<String>,
}

/// A trajectory as it travels: ROS names and meaning.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Trajectory {
    /// The joints, in the order of every point's values.
    pub joint_names: Vec<String>,
    /// The points, in order of time.
    pub points: Vec<Point>,
}

/// A point of a trajectory.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Point {
    /// Time since the trajectory's start [s].
    pub time_from_start: f64,
    /// Joint positions [rad].
    pub positions: Vec<f64>,
    /// Joint velocities [rad/s]; without them the path between points is the task's choice.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub velocities: Option<Vec<f64>>,
    /// Joint accelerations [rad/s²].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub accelerations: Option<Vec<f64>>,
}

impl Execute {
    fn valid(&self) -> Result<(), String> {
        let joints = self.trajectory.joint_names.len();
        if joints == 0 {
            return Err("trajectory.joint_names is empty".into());
        }
        for (index, point) in self.trajectory.points.iter().enumerate() {
            let at = |field| format!("trajectory.points[{index}].{field}");
            finite(&at("time_from_start"), &[point.time_from_start])?;
            let given = [
                ("positions", Some(&point.positions)),
                ("velocities", point.velocities.as_ref()),
                ("accelerations", point.accelerations.as_ref()),
            ];
            for (field, values) in given.into_iter().filter_map(|(field, v)| v.map(|v| (field, v))) {
                finite(&at(field), values)?;
                if values.len() != joints {
                    return Err(format!("{} has {} values for {joints} joints", at(field), values.len()));
                }
            }
        }
        Ok(())
    }
}

/// A motion that began with `execute`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ExecuteReply {
    /// The motion's number, for `motion`.
    pub motion: u64,
    /// The task that carries it out.
    pub task: String,
    /// How long the trajectory takes [s].
    pub duration: f64,
}

/// Parameters of `motion`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Motion {
    /// The motion's number.
    pub motion: u64,
}

/// Parameters of `cancel`: without any, every motion ends.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Cancel {
    /// Ends the motions that move this arm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub arm: Option<String>,
    /// Ends the motion of this task.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub task: Option<String>,
}

/// What `cancel` did, per task.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct CancelReply {
    /// The status word of each task asked: `CANCELLED` or `ALREADY_STOPPED`.
    pub tasks: BTreeMap<String, String>,
}

/// Parameters of `stop`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stop {
    /// Stops this arm only; without it, all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub arm: Option<String>,
}

/// What `stop` achieved, per arm.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct StopReply {
    /// Confirmation per arm.
    pub arms: BTreeMap<String, Confirmation>,
}

/// How far a stop is known to have reached the arm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Confirmation {
    /// The device answered that it stops.
    Confirmed,
    /// It was sent, but the device has not confirmed it (or has no way to).
    SentNotConfirmed,
    /// The device could not be reached.
    NotSent,
}

impl Confirmation {
    /// The words used in tables.
    pub fn text(self) -> &'static str {
        match self {
            Self::Confirmed => "confirmed",
            Self::SentNotConfirmed => "sent, not confirmed",
            Self::NotSent => "not sent: the arm cannot be reached",
        }
    }
}

/// Parameters of `arm_reset`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ArmReset {
    /// The arm's `hardware_id`.
    pub arm: String,
}

/// Parameters of `arm_enable`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ArmEnable {
    /// The arm's `hardware_id`.
    pub arm: String,
}

/// Parameters of `arm_disable`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ArmDisable {
    /// The arm's `hardware_id`.
    pub arm: String,
}

/// An arm after `arm_reset`, `arm_enable` or `arm_disable`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ArmReply {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// Its phase now.
    pub phase: String,
}

/// Parameters of `gripper`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Gripper {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// Opening [m].
    pub position: f64,
}

impl Gripper {
    fn valid(&self) -> Result<(), String> {
        finite("position", &[self.position])?;
        if self.position < 0.0 { Err(format!("position is {}, and cannot be negative", self.position)) } else { Ok(()) }
    }
}

/// Parameters of `servo`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Servo {
    /// The servo task's name.
    pub task: String,
    /// Joint positions [rad], in the order of the task's joints.
    pub positions: Vec<f64>,
}

impl Servo {
    fn valid(&self) -> Result<(), String> {
        finite("positions", &self.positions)
    }
}

/// Parameters of `velocity`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Velocity {
    /// The velocity task's name.
    pub task: String,
    /// Joint velocities [rad/s], in the order of the task's joints.
    pub velocities: Vec<f64>,
}

impl Velocity {
    fn valid(&self) -> Result<(), String> {
        finite("velocities", &self.velocities)
    }
}

/// One value per joint of an arm, each finite.
fn values(field: &str, values: &[f64]) -> Result<(), String> {
    if values.is_empty() || values.len() > MAX_DOF {
        return Err(format!("{field} has {} values, and must have 1 to {MAX_DOF}", values.len()));
    }
    finite(field, values)
}

/// JSON has no infinities, but callers in this process do.
fn finite(field: &str, values: &[f64]) -> Result<(), String> {
    match values.iter().find(|v| !v.is_finite()) {
        Some(v) => Err(format!("{field} has the value {v}, which is not finite")),
        None => Ok(()),
    }
}
