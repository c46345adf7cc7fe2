//! The methods of a run: a table with their parameters and replies, and [`Backend`], which answers requests.
//!
//! Units are SI (rad, rad/s, Nm, m, N, s); a field in another unit has it in its name (`age_ms`).

mod arm;
mod attach;
mod cartesian;
mod class;
mod gateway;
mod going;
mod ik;
mod model;
mod motion;
mod on_path;
mod parts;
mod planner;
mod poses;
pub mod schema;
mod text;
mod until;
mod world;

use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;

use schemars::{JsonSchema, SchemaGenerator};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::api::schema::MethodSchema;
use crate::error::{Code, RpcError};
use crate::report::{MotionReport, StateReport, StatusReport};
use crate::server::lease::{Need, Subject};
use crate::server::planner_proxy::PlannerProxy;
use crate::server::streams::Streams;
pub use arm::*;
pub use attach::*;
pub use cartesian::*;
pub use class::Class;
use dimos_core::telemetry::{Origin, Who};
pub use gateway::*;
pub use going::*;
pub use ik::*;
pub use model::*;
pub use motion::*;
pub use on_path::OnPath;
pub use parts::*;
pub use planner::*;
pub use poses::*;
pub use text::*;
pub use until::Until;
pub use world::*;

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
    /// for it. Dropped after [`server::CALL_TIMEOUT`](crate::server::CALL_TIMEOUT).
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
    /// Called when a request is refused before the run is asked: another connection holds an arm that it moves, or its
    /// parameters are wrong.
    fn refused(&self, method: &'static str, error: &RpcError) {
        let _ = (method, error);
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

/// One row per method: name, parameters, reply, the right that it needs over the network, the lease that it needs if
/// any, and what checks its values. Generates [`Request`], [`Reply`] and [`METHODS`].
macro_rules! methods {
    (@need $params:ident) => {{
        let _ = $params;
        Need::Nothing
    }};
    (@need $params:ident, $p:ident => $need:expr) => {{
        let $p = $params;
        $need
    }};
    ($($(#[$doc:meta])* $name:literal $variant:ident -> $reply:ty, $class:ident $(, needs $p:ident => $need:expr)?
        $(, check $check:path)?;)*) => {
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
        pub(crate) fn method_schemas(generator: &mut SchemaGenerator) -> Vec<MethodSchema> {
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

        /// Returns the right that a method of the table needs.
        fn class_of(method: &str) -> Option<Class> {
            match method {
                $($name => Some(Class::$class),)*
                _ => None,
            }
        }

        impl Request {
            /// Returns the lease that it requires.
            pub(crate) fn need(&self) -> Need<'_> {
                match self {
                    $(Self::$variant(params) => methods!(@need params $(, $p => $need)?),)*
                }
            }

            /// Returns the method's name.
            pub fn method(&self) -> &'static str {
                match self {
                    $(Self::$variant(_) => $name,)*
                }
            }

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
    "status" Status -> StatusReport, Read;
    /// The latest joint states and commands.
    "state" State -> StateReport, Read;
    /// What the run has printed for people: its text log.
    "text_log" TextLog -> TextLogReport, Read;
    /// Moves an arm to a joint target, directly: not collision-checked; in a run with a planner only with `direct`.
    /// Ends the client's own streams to the arm. Replies when the motion begins; `motion` reports its progress.
    "move" Move -> MoveReply, Move, needs p => Need::of_arm(&p.arm), check Move::valid;
    /// Follows a trajectory. Replies when the motion begins.
    "execute" Execute -> ExecuteReply, Move, needs p => Need::of_joints(&p.trajectory.joint_names),
        check Execute::valid;
    /// Progress or result of a motion.
    "motion" Motion -> MotionReport, Read;
    /// Carries out a motion as a whole: plans, executes, follows, grips, attaches, one step after the other. Replies at
    /// once; `going` reports its progress and its one outcome.
    "go" Go -> GoReply, Move, needs _p => Need::AtEachStep, check Go::valid;
    /// Progress or outcome of a request `go`.
    "going" Going -> GoingReport, Read;
    /// Ends motions by decelerating within limits: those of a task, of an arm, or all. With a plan, ends its planning
    /// only; with the number of a `go`, ends that.
    "cancel" Cancel -> CancelReply, End, check Cancel::valid;
    /// Reads or sets the speed override: all motions run at a fraction of their speed, or pause on their paths. Needs
    /// no lease: who watches an arm may slow it down, also one that another client moves.
    "speed" Speed -> SpeedReport, Move, check Speed::valid;
    /// Holds one arm or all at once: tasks end, arms are held until `arm_reset`. An operational stop.
    "stop" Stop -> StopReply, End;
    /// Clears a latched hold or a fault. Moves nothing, enables nothing.
    "arm_reset" ArmReset -> ArmReply, Enable, needs p => Need::no_other_of(&p.arm);
    /// Enables the motors at the current position and makes the arm ready for motion.
    "arm_enable" ArmEnable -> ArmReply, Enable, needs p => Need::no_other_of(&p.arm);
    /// Lets the arm be led by hand, at rest: `arm_take_over` or `arm_enable` ends that.
    "arm_teach" ArmTeach -> ArmReply, Enable, needs p => Need::no_other_of(&p.arm);
    /// Makes a led arm ready where it is held still. Refused if it is not led, or no longer.
    "arm_take_over" ArmTakeOver -> ArmReply, Enable, needs p => Need::no_other_of(&p.arm);
    /// Lets the arm's own controller move it to a pose: not collision-checked; in a run with a planner only with
    /// `direct`. Replies when the motion begins; `motion` reports its end.
    "move_native" MoveNative -> NativeReply, Move, needs p => Need::of_arm(&p.arm), check MoveNative::valid;
    /// Decelerates the arm to rest and disables the motors. An arm without brakes falls.
    "arm_disable" ArmDisable -> ArmReply, Move, needs p => Need::no_other_of(&p.arm);
    /// Commands a gripper. Replies when the command was sent; `grip` reports its outcome.
    "gripper" Gripper -> GripperReply, Move, needs p => Need::of_arm(&p.arm), check Gripper::valid;
    /// Homes a gripper that has its own connection, if it needs that: its fingers move. Replies when that has begun;
    /// `status` shows the end.
    "gripper_home" GripperHome -> GripperHomeReply, Move, needs p => Need::of_arm(&p.arm);
    /// Progress or outcome of a gripper command.
    "grip" Grip -> GripReport, Read;
    /// Levels of an arm's digital and analogue inputs and outputs.
    "arm_io" ArmIo -> IoReport, Read;
    /// Sets digital and analogue outputs of an arm, and reads them back.
    "arm_io_set" ArmIoSet -> IoReport, Move, needs p => Need::no_other_of(&p.arm), check ArmIoSet::valid;
    /// The load at an arm's flange that its controller calculates with.
    "arm_payload" ArmPayload -> PayloadReply, Read;
    /// Sets the load at an arm's flange, and reads it back. The arm must be at rest.
    "arm_payload_set" ArmPayloadSet -> PayloadReply, Move, needs p => Need::no_other_of(&p.arm),
        check ArmPayloadSet::valid;
    /// Finds the load at an arm's flange from its efforts at rest, with the arm's model. Sets nothing.
    "arm_payload_find" ArmPayloadFind -> FoundPayload, Read, check ArmPayloadFind::valid;
    /// Makes the present force and torque at an arm zero, for `until`, `state` and the log. The arm must be at rest.
    "arm_tare" ArmTare -> TareReply, Move, needs p => Need::no_other_of(&p.arm);
    /// The robots of the run in one URDF, and the transforms in it that do not change.
    "robot_description" RobotDescription -> DescriptionReport, Read;
    /// The poses of the robots' links and tool centre points after the last tick.
    "transforms" Transforms -> TransformsReport, Read;
    /// The saved poses of the run's blueprint.
    "poses" Poses -> PosesReport, Read;
    /// Saves the measured joint positions of arms under a name, for the goal `named` of `plan`.
    "pose_save" PoseSave -> PoseSaved, Move, check PoseSave::valid;
    /// Removes a saved pose.
    "pose_remove" PoseRemove -> Done, Move;
    /// The tool centre point of an arm.
    "arm_tool" ArmTool -> ArmToolReply, Read;
    /// Sets the tool of an arm, in the planner and in the tasks that move its end effector. The arm must be at rest.
    "arm_tool_set" ArmToolSet -> ArmToolReply, Move, needs p => Need::no_other_of(&p.arm), check ArmToolSet::valid;
    /// Next target of a servo task; repeat it within the task's timeout.
    "servo" Servo -> Done, Move, needs p => Need::of_task(&p.task), check Servo::valid;
    /// Next target of a velocity task; repeat it within the task's timeout.
    "velocity" Velocity -> Done, Move, needs p => Need::of_task(&p.task), check Velocity::valid;
    /// Next chunk of a chunk task: positions with times, as a learned policy makes them.
    "chunk" Chunk -> ChunkReply, Move, needs p => Need::of_task(&p.task), check Chunk::valid;
    /// Next target of an `eef_twist` task; repeat it within the task's timeout.
    "twist" Twist -> Done, Move, needs p => Need::of_task(&p.task), check Twist::valid;
    /// Next target of a `cartesian_ik` task; repeat it within the task's timeout.
    "pose" Pose -> Done, Move, needs p => Need::of_task(&p.task), check Pose::valid;
    /// Starts a task that takes no targets: a `follow` task. `cancel` ends it.
    "start" Start -> Done, Move, needs p => Need::of_task(&p.task);
    /// Plans a collision-free motion. Replies when planning begins; `planning` reports its progress. Moves nothing.
    "plan" Plan -> PlanReply, Plan, check Plan::valid;
    /// Progress or result of planning.
    "planning" Planning -> PlanningReport, Read;
    /// A plan in full: the trajectory, and the paths of the end effectors.
    "preview" Preview -> PreviewReply, Read, check Preview::valid;
    /// Executes a plan. Replies when the motion begins.
    "execute_plan" ExecutePlan -> ExecuteReply, Move, needs p => Need::Plan(p.plan), check ExecutePlan::valid;
    /// The planner's state and robots.
    "planner" Planner -> PlannerReport, Read;
    /// Inverse kinematics: joint positions for a pose of a robot, and what touches there. Moves nothing.
    "ik" Ik -> IkReply, Plan, check Ik::valid;
    /// The objects of the planner's world.
    "world" World -> WorldReport, Read;
    /// Adds an object to the world, or replaces the one of the same name.
    "world_add" WorldAdd -> Done, Plan, check WorldAdd::valid;
    /// Moves an object of the world.
    "world_move" WorldMove -> Done, Plan, check WorldMove::valid;
    /// Removes an object of the world, or all.
    "world_remove" WorldRemove -> Done, Plan;
    /// Attaches an object to a robot at its current pose.
    "attach" Attach -> AttachReply, Plan, needs p => Need::of_load(p.mass), check Attach::valid;
    /// Detaches an object; it stays at its current pose.
    "detach" Detach -> Done, Plan, needs _p => Need::NoOtherHolderOfLoad;
    /// Shuts the run down like SIGTERM. Replies before it begins.
    "shutdown" Shutdown -> Done, Own;
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
pub(crate) fn finite(field: &str, values: &[f64]) -> Result<(), String> {
    match values.iter().find(|v| !v.is_finite()) {
        Some(v) => Err(format!("{field} has the value {v}, which is not finite")),
        None => Ok(()),
    }
}
