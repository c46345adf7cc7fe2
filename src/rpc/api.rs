//! What a run can be asked: the table of methods, their parameters and replies, and [`Backend`], which answers.
//!
//! Everything is in SI units (rad, rad/s, Nm, m, N, s); a field in another unit says so in its name (`age_ms`).

use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;

use schemars::{JsonSchema, SchemaGenerator};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;

pub use super::arm_api::*;
pub use super::attach_api::*;
pub use super::cartesian_api::*;
use super::error::{Code, RpcError};
use super::lease::Subject;
pub use super::motion_api::*;
pub use super::planner_api::*;
use super::planner_line::PlannerLine;
use super::report::{MotionReport, StateReport, StatusReport};
use super::schema::MethodSchema;
use super::streams::Streams;
pub use super::world_api::*;

/// Longest request line, newline included [bytes].
pub const MAX_LINE: usize = 256 * 1024;
/// Most connections to one run.
pub const MAX_CONNECTIONS: usize = 128;
/// Connections beside those that may `stop`, `cancel`, ask for `status` and `shutdown`.
pub const RESERVED_CONNECTIONS: usize = 8;
/// Most subscriptions of one connection.
pub const MAX_SUBSCRIPTIONS: usize = 16;
/// Lowest `speed` of a move, as a fraction of the arm's limits.
pub const MIN_SPEED: f64 = 0.1;

/// A boxed future, as trait objects need it.
pub type BoxFuture<'a, T> = Pin<Box<dyn Future<Output = T> + Send + 'a>>;

/// What the server serves: the run itself.
pub trait Backend: Send + Sync + 'static {
    /// Answers one request. Called from the server's threads, several at once; it may wait but must not block, or a
    /// stop would wait for it. When it takes longer than [`server::CALL_LIMIT`](super::server::CALL_LIMIT) it is
    /// dropped.
    fn call(&self, request: Request) -> BoxFuture<'_, Result<Reply, RpcError>>;
    /// The arms that `subject` is about, by `hardware_id`; none where it names something that is not there. Who
    /// moves an arm needs its lease.
    fn arms_of(&self, subject: Subject<'_>) -> Vec<String>;
    /// The number of a plan, the newest without one, and the coordinator's joints that it moves.
    fn plan_of(&self, plan: Option<u64>) -> BoxFuture<'_, Result<(u64, Vec<String>), RpcError>> {
        let _ = plan;
        Box::pin(async { Err(RpcError::new(Code::NoPlanner, "this run has no planner")) })
    }
    /// Lets the process at the other end of `line` be the run's planner.
    fn register_planner(&self, planner: RegisterPlanner, line: Arc<PlannerLine>) -> Result<Registered, RpcError> {
        let _ = (planner, line);
        Err(RpcError::new(Code::Unsupported, "this run takes no planner"))
    }
    /// Called once on the thread that answers `stop`, `cancel`, `status` and `shutdown`, before it does.
    fn prepare_urgent_thread(&self) {}
    /// What the run publishes.
    fn streams(&self) -> &Streams;
}

/// The parameters of a method, which know the method's name and reply.
pub trait Method: Serialize + DeserializeOwned + JsonSchema {
    /// The method's name.
    const NAME: &'static str;
    /// What comes back.
    type Reply: Serialize + DeserializeOwned + JsonSchema;
    /// Says what is wrong with the values, in a sentence without full stop.
    fn check(&self) -> Result<(), String> {
        Ok(())
    }
    /// The request to the run; `None`: the connection itself answers it.
    fn to_request(&self) -> Option<Request> {
        None
    }
    /// Takes the reply to such a request; `None`: it is the reply to another one.
    fn from_reply(_reply: Reply) -> Option<Self::Reply> {
        None
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
        pub enum Reply { $($(#[$doc])* $variant($reply),)* }

        /// Names of all methods, those that the connection itself answers at the end.
        pub const METHODS: &[&str] = &[$($name,)* "subscribe", "unsubscribe", "lease", "release",
            "register_planner", "planner_answer"];

        /// Name, parameters and reply of each method in the table.
        pub(super) fn method_schemas(generator: &mut SchemaGenerator) -> Vec<MethodSchema> {
            vec![$(MethodSchema::of::<$variant>(generator),)*]
        }

        impl Reply {
            /// Reads what came back from a method.
            pub fn read(method: &str, reply: Value) -> Result<Self, RpcError> {
                let unlike = |e: serde_json::Error| RpcError::new(Code::Internal, format!("reply to {method:?}: {e}"));
                match method {
                    $($name => serde_json::from_value::<$reply>(reply).map(Self::$variant).map_err(unlike),)*
                    _ => Err(RpcError::unknown(Code::UnknownMethod, "method", method, METHODS)),
                }
            }
        }

        $(impl Method for $variant {
            const NAME: &'static str = $name;
            type Reply = $reply;
            $(fn check(&self) -> Result<(), String> { $check(self) })?
            fn to_request(&self) -> Option<Request> {
                Some(Request::$variant(Clone::clone(self)))
            }
            fn from_reply(reply: Reply) -> Option<$reply> {
                match reply {
                    Reply::$variant(reply) => Some(reply),
                    _ => None,
                }
            }
        })*

        impl Request {
            /// The method's name and its parameters, as they travel.
            pub fn written(&self) -> (&'static str, Value) {
                // Plain structs with string keys always encode.
                match self {
                    $(Self::$variant(params) => ($name, serde_json::to_value(params).unwrap_or_default()),)*
                }
            }

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
    /// begins; `motion` reports its progress.
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
    /// Next target of an `eef_twist` task; repeat it within the task's timeout.
    "twist" Twist -> Done, check Twist::valid;
    /// Next target of a `cartesian_ik` task; repeat it within the task's timeout.
    "pose" Pose -> Done, check Pose::valid;
    /// Plans a collision-free motion. Answers when planning begins; `planning` reports its progress. Moves nothing.
    "plan" Plan -> PlanReply, check Plan::valid;
    /// How planning goes, or what came of it.
    "planning" Planning -> PlanningReport;
    /// A plan in full: the trajectory, and the way of the end effectors.
    "preview" Preview -> PreviewReply;
    /// Carries out a plan. Answers when the motion begins.
    "execute_plan" ExecutePlan -> ExecuteReply;
    /// What the planner is and does.
    "planner" Planner -> PlannerReport;
    /// The objects of the planner's world.
    "world" World -> WorldReport;
    /// Puts an object into the world, or another one in its place.
    "world_add" WorldAdd -> Done, check WorldAdd::valid;
    /// Moves an object of the world.
    "world_move" WorldMove -> Done, check WorldMove::valid;
    /// Removes an object of the world, or all.
    "world_remove" WorldRemove -> Done;
    /// Lets a robot hold an object, where it is now.
    "attach" Attach -> Done;
    /// Lets go of an object: it stays where it is.
    "detach" Detach -> Done;
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
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Status {}

/// Parameters of `state`: none.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct State {}

/// Parameters of `shutdown`: none.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Shutdown {}

/// Done; nothing to tell.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Done {}

/// JSON has no infinities, but callers in this process do.
pub(super) fn finite(field: &str, values: &[f64]) -> Result<(), String> {
    match values.iter().find(|v| !v.is_finite()) {
        Some(v) => Err(format!("{field} has the value {v}, which is not finite")),
        None => Ok(()),
    }
}
