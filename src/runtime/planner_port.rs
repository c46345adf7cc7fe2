//! The planner of a run: its desk, and what is known of it beside. Answers the planner's methods.

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::time::Duration;

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

use super::dispatch::lock;
use super::plan_requests::{found, job, report};
use super::service::{Service, internal};
use super::world_requests::{self, typed};
use crate::planning::config::PlannerConfig;
use crate::planning::desk::Desk;
use crate::planning::setup::Setup;
use crate::rpc::api::{PoseSpec, Reply, Request as Call, WorldAdd, WorldObject, WorldReport};
use crate::rpc::{Code, RpcError};

/// A state older than this is no place to plan from.
const FRESH: Duration = Duration::from_secs(1);

/// The planner of a run.
pub struct PlannerPort {
    pub(super) desk: Desk,
    /// The objects of the world, as they were given.
    pub(super) objects: Mutex<BTreeMap<String, WorldObject>>,
    /// The plan that was handed to the coordinator last, and its motion.
    pub(super) executed: Mutex<Option<(u64, u64)>>,
}

impl PlannerPort {
    /// Reads the robots' descriptions and the world's files, and starts the planner's thread.
    pub fn start(config: &PlannerConfig) -> Result<Self, String> {
        let setup = Setup::load(config)?;
        let objects = config.objects.iter().map(|object| (object.name.clone(), typed(object))).collect();
        let desk = Desk::start(setup, config.timeout).map_err(|e| format!("no planner thread: {e}"))?;
        Ok(Self { desk, objects: Mutex::new(objects), executed: Mutex::default() })
    }

    /// Pairs of links that touch in every pose, with their robot's name.
    pub fn always_touching(&self) -> &[(String, [String; 2])] {
        &self.desk.setup().always_touching
    }
}

impl Service {
    /// Answers the planner's methods.
    pub(super) async fn planner_call(&self, call: Call) -> Result<Reply, RpcError> {
        let port = self.parts.planner.as_ref().ok_or_else(|| {
            RpcError::new(Code::NoPlanner, "this run has no planner")
                .hint("run a planner blueprint, such as yourarm-planner")
        })?;
        match call {
            Call::Plan(plan) => self.begin_plan(port, &plan).map(Reply::Plan),
            Call::Planning(planning) => Ok(Reply::Planning(report(&job(port, Some(planning.plan))?))),
            Call::Preview(preview) => self.preview(port, preview.plan).map(Reply::Preview),
            Call::ExecutePlan(execute) => self.execute_plan(port, execute.plan).await,
            Call::Planner(_) => Ok(Reply::Planner(self.planner_report(port))),
            Call::World(_) => {
                let objects = lock(&port.objects).values().cloned().collect();
                Ok(Reply::World(WorldReport { objects }))
            }
            Call::WorldAdd(WorldAdd(object)) => world_requests::put(port, object).await.map(Reply::WorldAdd),
            Call::WorldMove(call) => world_requests::move_to(port, &call).map(Reply::WorldMove),
            Call::WorldRemove(call) => world_requests::remove(port, call.name.as_deref()).map(Reply::WorldRemove),
            Call::Attach(call) => self.attach(port, &call).map(Reply::Attach),
            Call::Detach(call) => self.detach(port, &call.name).map(Reply::Detach),
            _ => Err(internal()),
        }
    }

    /// Ends planning, where something is being planned.
    pub(super) fn cancel_planning(&self) -> bool {
        self.parts.planner.as_ref().is_some_and(|port| port.desk.cancel())
    }

    /// The coordinator's joints that a plan moves; none where there is no such plan.
    pub(super) fn joints_of_plan(&self, plan: Option<u64>) -> Vec<String> {
        let found = self.parts.planner.as_ref().and_then(|port| found(port, plan).ok());
        found.map(|(_, found)| found.trajectory.joint_names.clone()).unwrap_or_default()
    }

    /// Where every robot of the planner is [rad]: where it is commanded to be, where positions are commanded.
    pub(super) fn robot_positions(&self, setup: &Setup) -> Result<Vec<Vec<f64>>, RpcError> {
        setup.robots.iter().map(|robot| self.positions_of(&robot.config.coordinator_joints)).collect()
    }

    pub(super) fn positions_of(&self, joints: &[String]) -> Result<Vec<f64>, RpcError> {
        let now = self.now();
        let position = |name: &String| {
            let arms = self.parts.names.arms.iter().enumerate();
            let place = { arms }.find_map(|(a, arm)| Some((a, arm.joints.iter().position(|j| j == name)?)));
            let (arm, joint) = place.ok_or_else(internal)?;
            let unknown = || {
                let id = &self.parts.names.arms[arm].hardware_id;
                RpcError::new(Code::StartStateUnavailable, format!("{id}: no state that is younger than 1 s"))
                    .hint("`dimos status` shows what the arm waits for")
            };
            let view = self.arm_view(arm).filter(|view| view.state.seq > 0).ok_or_else(unknown)?;
            if now.since(view.state.stamp) > FRESH {
                return Err(unknown());
            }
            let commanded = view.command.mode.is_some_and(|mode| mode.is_position());
            let values = if commanded { view.command.values } else { view.state.position };
            values.get(joint).copied().ok_or_else(internal)
        };
        joints.iter().map(position).collect()
    }
}

/// Does work of the planner on a thread of its own: neither what it reads nor a panic in it may keep other requests
/// waiting, `stop` least of all.
pub(super) async fn apart<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, RpcError> {
    let failed = |_| RpcError::new(Code::Internal, "the planner failed at this request: a defect of the program");
    tokio::task::spawn_blocking(work).await.map_err(failed)
}

pub(super) fn robot_index(setup: &Setup, name: &str) -> Result<usize, RpcError> {
    let names: Vec<&str> = setup.robots.iter().map(|robot| robot.config.name.as_str()).collect();
    setup.robot(name).ok_or_else(|| RpcError::unknown(Code::UnknownRobot, "robot", name, &names))
}

pub(super) fn isometry(spec: &PoseSpec) -> Isometry3<f64> {
    let [x, y, z] = spec.xyz;
    let rotation = match (spec.quat, spec.rpy) {
        (Some([x, y, z, w]), _) => UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)),
        (None, Some([roll, pitch, yaw])) => UnitQuaternion::from_euler_angles(roll, pitch, yaw),
        (None, None) => UnitQuaternion::identity(),
    };
    Isometry3::from_parts(Translation3::new(x, y, z), rotation)
}

pub(super) fn spec(pose: &Isometry3<f64>) -> PoseSpec {
    let q = pose.rotation.coords;
    PoseSpec { xyz: pose.translation.vector.into(), rpy: None, quat: Some([q.x, q.y, q.z, q.w]) }
}
