//! The methods of a run: a table with their parameters and replies, and [`Backend`], which answers requests.
//!
//! Units are SI (rad, rad/s, Nm, m, N, s); a field in another unit has it in its name (`age_ms`).

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
pub use super::gateway_api::*;
pub use super::ik_api::*;
use super::lease::Subject;
pub use super::model_api::*;
pub use super::motion_api::*;
pub use super::parts_api::*;
pub use super::planner_api::*;
use super::planner_proxy::PlannerProxy;
pub use super::poses_api::*;
use super::report::{MotionReport, StateReport, StatusReport};
use super::schema::MethodSchema;
use super::streams::Streams;
pub use super::text_api::*;
pub use super::world_api::*;
use dimos_core::telemetry::{Origin, Who};

/// Maximum length of a request line, including its newline [bytes].
pub const MAX_LINE: usize = 256 * 1024;
/// Maximum number of connections to a run.
pub const MAX_CONNECTIONS: usize = 128;
/// Further connections, reserved for `stop`, `cancel`, `status` and `shutdown`.
pub const RESERVED_CONNECTIONS: usize = 8;
/// Maximum number of subscriptions of a connection.
pub const MAX_SUBSCRIPTIONS: usize = 16;
/// Minimum `speed` of a motion, as a fraction of the highest.
pub const MIN_SPEED: f64 = dimos_core::joint::LOWEST_SPEED;

/// A boxed future, for trait objects.
pub type BoxFuture<'a, T> = Pin<Box<dyn Future<Output = T> + Send + 'a>>;

/// Answers the requests that the server receives: the run.
pub trait Backend: Send + Sync + 'static {
    /// Answers one request. Called concurrently from the server's threads. Must not block its thread: a stop may wait
    /// for it. Dropped after [`server::CALL_TIMEOUT`](super::server::CALL_TIMEOUT).
    fn call(&self, request: Request) -> BoxFuture<'_, Result<Reply, RpcError>>;
    /// Same, for a request that this client made then; `origin` is `None` if it moves nothing.
    fn call_from(
        &self,
        request: Request,
        origin: Option<Origin>,
        who: Arc<Who>,
    ) -> BoxFuture<'_, Result<Reply, RpcError>> {
        let _ = (origin, who);
        self.call(request)
    }
    /// Returns the number of interruptions of all arms so far.
    fn epoch(&self) -> u64 {
        0
    }
    /// Called when a connection takes the lease of an arm with `lease`, not with a request.
    fn lease_taken(&self, arm: &str, client: u64) -> Result<(), RpcError> {
        let _ = (arm, client);
        Ok(())
    }
    /// Waits until the run has handled what was passed to it before.
    fn handled(&self) -> BoxFuture<'_, ()> {
        Box::pin(std::future::ready(()))
    }
    /// Called before another connection can take the lease of an arm that was released.
    fn lease_ended(&self, arm: &str, client: u64) {
        let _ = (arm, client);
    }
    /// Returns the arms of `subject` by `hardware_id`, for leases; empty if it names something unknown.
    fn arms_of(&self, subject: Subject<'_>) -> Vec<String>;
    /// Returns the number of a plan (`None`: the newest one), and the coordinator's joints that it moves.
    fn plan_of(&self, plan: Option<u64>) -> BoxFuture<'_, Result<(u64, Vec<String>), RpcError>> {
        let _ = plan;
        Box::pin(async { Err(RpcError::new(Code::NoPlanner, "this run has no planner")) })
    }
    /// Returns the arms whose load an `attach` or `detach` changes, by `hardware_id`.
    fn arms_of_load<'a>(&'a self, request: &'a Request) -> BoxFuture<'a, Result<Vec<String>, RpcError>> {
        let _ = request;
        Box::pin(async { Ok(Vec::new()) })
    }
    /// Attaches a planner in another process to the run; `proxy` sends it requests.
    fn register_planner(&self, planner: RegisterPlanner, proxy: Arc<PlannerProxy>) -> Result<Registered, RpcError> {
        let _ = (planner, proxy);
        Err(RpcError::new(Code::Unsupported, "this run cannot have a planner"))
    }
    /// Called when a face of the gateway serves no more, or not at all.
    fn face_fell(&self, face: &FaceReport) {
        let _ = face;
    }
    /// Called once on the thread that answers `stop`, `cancel`, `status` and `shutdown`, before the first request.
    fn prepare_urgent_thread(&self) {}
    /// Returns the streams that the run publishes.
    fn streams(&self) -> &Streams;
}

/// Parameters of a method, with the method's name and the type of its reply.
pub trait Method: Serialize + DeserializeOwned + JsonSchema {
    /// The method's name.
    const NAME: &'static str;
    /// The reply.
    type Reply: Serialize + DeserializeOwned + JsonSchema;
    /// Checks the values; the error says what is wrong, without full stop.
    fn check(&self) -> Result<(), String> {
        Ok(())
    }
    /// Returns the request to the run; `None` if the connection itself answers the method.
    fn to_request(&self) -> Option<Request> {
        None
    }
    /// Returns the reply to such a request; `None` if it belongs to another method.
    fn from_reply(_reply: Reply) -> Option<Self::Reply> {
        None
    }
}

/// One row per method: name, parameters, reply. Generates [`Request`], [`Reply`] and [`METHODS`].
macro_rules! methods {
    ($($(#[$doc:meta])* $name:literal $variant:ident -> $reply:ty $(, check $check:path)?;)*) => {
        /// A request to the run.
        #[derive(Debug, Clone, PartialEq)]
        pub enum Request { $($(#[$doc])* $variant($variant),)* }

        /// A reply of the run: the variant of the same name.
        #[derive(Debug, Clone, PartialEq, Serialize)]
        #[serde(untagged)]
        pub enum Reply { $($(#[$doc])* $variant($reply),)* }

        /// Names of all methods; the last ones are answered by the connection itself.
        pub const METHODS: &[&str] = &[$($name,)* "subscribe", "unsubscribe", "lease", "release",
            "register_planner", "planner_answer", "on_behalf_of", "register_gateway"];

        /// Returns the schemas of each method in the table.
        pub(super) fn method_schemas(generator: &mut SchemaGenerator) -> Vec<MethodSchema> {
            vec![$(MethodSchema::of::<$variant>(generator),)*]
        }

        impl Reply {
            /// Parses the reply to a method.
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
            /// Returns the method's name and its parameters as JSON.
            pub fn written(&self) -> (&'static str, Value) {
                // Plain structs with string keys always encode.
                match self {
                    $(Self::$variant(params) => ($name, serde_json::to_value(params).unwrap_or_default()),)*
                }
            }

            /// Parses the parameters of a method; fails on unknown methods and on unknown or invalid parameters.
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
    /// What the run has printed for people: its text log.
    "text_log" TextLog -> TextLogReport;
    /// Moves an arm to a joint target, directly: not collision-checked; in a run with a planner only with `direct`.
    /// Ends the client's own streams to the arm. Replies when the motion begins; `motion` reports its progress.
    "move" Move -> MoveReply, check Move::valid;
    /// Follows a trajectory. Replies when the motion begins.
    "execute" Execute -> ExecuteReply, check Execute::valid;
    /// Progress or result of a motion.
    "motion" Motion -> MotionReport;
    /// Ends motions by decelerating within limits: those of a task, of an arm, or all. With a plan, ends its planning
    /// only.
    "cancel" Cancel -> CancelReply, check Cancel::valid;
    /// Reads or sets the speed override: all motions run at a fraction of their speed, or pause on their paths. Needs
    /// no lease.
    "speed" Speed -> SpeedReport, check Speed::valid;
    /// Holds one arm or all at once: tasks end, arms are held until `arm_reset`. An operational stop.
    "stop" Stop -> StopReply;
    /// Clears a latched hold or a fault. Moves nothing, enables nothing.
    "arm_reset" ArmReset -> ArmReply;
    /// Enables the motors at the current position and makes the arm ready for motion.
    "arm_enable" ArmEnable -> ArmReply;
    /// Lets the arm be led by hand, at rest: `arm_take_over` or `arm_enable` ends that.
    "arm_teach" ArmTeach -> ArmReply;
    /// Makes a led arm ready where it is held still. Refused if it is not led, or no longer.
    "arm_take_over" ArmTakeOver -> ArmReply;
    /// Lets the arm's own controller move it to a pose: not collision-checked; in a run with a planner only with
    /// `direct`. Replies when the motion begins; `motion` reports its end.
    "move_native" MoveNative -> NativeReply, check MoveNative::valid;
    /// Decelerates the arm to rest and disables the motors. An arm without brakes falls.
    "arm_disable" ArmDisable -> ArmReply;
    /// Commands a gripper. Replies when the command was sent; `grip` reports its outcome.
    "gripper" Gripper -> GripperReply, check Gripper::valid;
    /// Progress or outcome of a gripper command.
    "grip" Grip -> GripReport;
    /// Levels of an arm's digital and analogue inputs and outputs.
    "arm_io" ArmIo -> IoReport;
    /// Sets digital and analogue outputs of an arm, and reads them back.
    "arm_io_set" ArmIoSet -> IoReport, check ArmIoSet::valid;
    /// The load at an arm's flange that its controller calculates with.
    "arm_payload" ArmPayload -> PayloadReply;
    /// Sets the load at an arm's flange, and reads it back. The arm must be at rest.
    "arm_payload_set" ArmPayloadSet -> PayloadReply, check ArmPayloadSet::valid;
    /// The robots of the run in one URDF, and the transforms in it that do not change.
    "robot_description" RobotDescription -> DescriptionReport;
    /// The poses of the robots' links and tool centre points after the last tick.
    "transforms" Transforms -> TransformsReport;
    /// The saved poses of the run's blueprint.
    "poses" Poses -> PosesReport;
    /// Saves the measured joint positions of arms under a name, for the goal `named` of `plan`.
    "pose_save" PoseSave -> PoseSaved, check PoseSave::valid;
    /// Removes a saved pose.
    "pose_remove" PoseRemove -> Done;
    /// The tool centre point of an arm.
    "arm_tool" ArmTool -> ArmToolReply;
    /// Sets the tool of an arm, in the planner and in the tasks that move its end effector. The arm must be at rest.
    "arm_tool_set" ArmToolSet -> ArmToolReply, check ArmToolSet::valid;
    /// Next target of a servo task; repeat it within the task's timeout.
    "servo" Servo -> Done, check Servo::valid;
    /// Next target of a velocity task; repeat it within the task's timeout.
    "velocity" Velocity -> Done, check Velocity::valid;
    /// Next chunk of a chunk task: positions with times, as a learned policy makes them.
    "chunk" Chunk -> ChunkReply, check Chunk::valid;
    /// Next target of an `eef_twist` task; repeat it within the task's timeout.
    "twist" Twist -> Done, check Twist::valid;
    /// Next target of a `cartesian_ik` task; repeat it within the task's timeout.
    "pose" Pose -> Done, check Pose::valid;
    /// Starts a task that takes no targets: a `follow` task. `cancel` ends it.
    "start" Start -> Done;
    /// Plans a collision-free motion. Replies when planning begins; `planning` reports its progress. Moves nothing.
    "plan" Plan -> PlanReply, check Plan::valid;
    /// Progress or result of planning.
    "planning" Planning -> PlanningReport;
    /// A plan in full: the trajectory, and the paths of the end effectors.
    "preview" Preview -> PreviewReply, check Preview::valid;
    /// Executes a plan. Replies when the motion begins.
    "execute_plan" ExecutePlan -> ExecuteReply, check ExecutePlan::valid;
    /// The planner's state and robots.
    "planner" Planner -> PlannerReport;
    /// Inverse kinematics: joint positions for a pose of a robot, and what touches there. Moves nothing.
    "ik" Ik -> IkReply, check Ik::valid;
    /// The objects of the planner's world.
    "world" World -> WorldReport;
    /// Adds an object to the world, or replaces the one of the same name.
    "world_add" WorldAdd -> Done, check WorldAdd::valid;
    /// Moves an object of the world.
    "world_move" WorldMove -> Done, check WorldMove::valid;
    /// Removes an object of the world, or all.
    "world_remove" WorldRemove -> Done;
    /// Attaches an object to a robot at its current pose.
    "attach" Attach -> AttachReply, check Attach::valid;
    /// Detaches an object; it stays at its current pose.
    "detach" Detach -> Done;
    /// Shuts the run down like SIGTERM. Replies before it begins.
    "shutdown" Shutdown -> Done;
}

/// Parses and checks the parameters of a method; null means `{}`.
pub fn read_params<M: Method>(params: Value) -> Result<M, RpcError> {
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

/// Reply without data.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Done {}

/// Checks that all values are finite. JSON has only finite numbers, but callers in this process may pass others.
pub(super) fn finite(field: &str, values: &[f64]) -> Result<(), String> {
    match values.iter().find(|v| !v.is_finite()) {
        Some(v) => Err(format!("{field} has the value {v}, which is not finite")),
        None => Ok(()),
    }
}
