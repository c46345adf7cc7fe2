//! Answers the planner's methods: the planner thread, the objects of the world, the executed plans. All it needs of the
//! run comes with a request, so it works in the run's process and in its own.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use nalgebra::Isometry3;

use super::PlannerPort;
use super::plan_requests::job;
use super::world_requests::typed;
use crate::metrics::PlannerFigures;
use crate::runtime::internal;
use crate::runtime::tool::tcp::TcpModel;
use dimos_core::pose;
use dimos_core::sync::lock;
use dimos_planner::planning::request::pipeline::solve;
use dimos_planner::planning::request::planner_thread::{PlannerThread, Solver};
use dimos_planner::planning::scene::config::PlannerConfig;
use dimos_planner::planning::scene::planning_scene::PlanningScene;
use dimos_planner::planning::scene::unplanned_joints::Measured;
use dimos_rpc::api::{
    ArmToolReply, ArmToolSet, CancelReply, CommandLimits, Moment, PoseSpec, RegisteredRobot, Reply, WorldObject,
};
use dimos_rpc::api::{Request as Call, WorldAdd, WorldReport};
use dimos_rpc::{Code, RpcError};

impl PlannerPort {
    /// Returns the planning scene as it was built.
    pub fn setup(&self) -> &PlanningScene {
        self.thread.setup()
    }

    /// Returns the planning scene with the present tools and positions.
    #[cfg(test)]
    pub fn now(&self) -> Arc<PlanningScene> {
        self.thread.now()
    }

    /// Returns the objects of the world by name, and the version of the world with them, if that is not `known`.
    pub fn objects_unless(&self, known: Option<u64>) -> Option<(u64, BTreeMap<String, WorldObject>)> {
        let objects = lock(&self.objects);
        let version = self.thread.version();
        (known != Some(version)).then(|| (version, objects.clone()))
    }

    /// Starts the planner thread, for robots within the limits of the coordinator. `solver` replaces the built-in
    /// planner.
    pub fn start(
        config: &PlannerConfig,
        setup: PlanningScene,
        limits: &BTreeMap<String, CommandLimits>,
        solver: Option<Solver>,
    ) -> Result<Self, String> {
        let setup = setup.within(limits)?;
        let objects = config.objects.iter().map(|object| (object.name.clone(), typed(object))).collect();
        let thread = PlannerThread::with(setup, config.timeout, solver.unwrap_or_else(|| Arc::new(solve)));
        let thread = thread.map_err(|e| format!("no planner thread: {e}"))?;
        Ok(Self { thread, measured: Mutex::default(), objects: Mutex::new(objects), released: Mutex::default() })
    }

    /// Takes the positions of the joints that are not planned.
    pub(in crate::runtime) fn measured(&self, moment: &Moment) {
        let Moment { positions, grippers, paddings, .. } = moment.clone();
        if !positions.is_empty() {
            *lock(&self.measured) = Some(Instant::now());
        }
        self.thread.measured(&Measured { positions, grippers, paddings });
    }

    /// Returns how long ago the run last sent the positions of its arms; `None`: not yet.
    pub(in crate::runtime) fn age(&self) -> Option<Duration> {
        lock(&self.measured).map(|at| at.elapsed())
    }

    /// Returns how the planner's requests have ended.
    pub(in crate::runtime) fn figures(&self) -> PlannerFigures {
        let tally = self.thread.tally();
        PlannerFigures {
            ended: [("PLANNED", tally.found), ("FAILED", tally.failed), ("CANCELLED", tally.cancelled)],
            durations: tally.durations(),
        }
    }

    /// Answers one of the planner's methods, except `execute_plan`: see [`release`](Self::release).
    pub async fn answer(&self, call: Call, moment: &Moment) -> Result<Reply, RpcError> {
        match call {
            Call::Plan(plan) => self.begin_plan(&plan, moment).map(Reply::Plan),
            Call::Planning(planning) => {
                Ok(Reply::Planning(super::plan_requests::report(&job(self, Some(planning.plan))?)))
            }
            Call::Preview(preview) => self.preview(&preview).map(Reply::Preview),
            Call::Planner(_) => Ok(Reply::Planner(self.report())),
            Call::Ik(call) => self.ik(call, moment).await.map(Reply::Ik),
            Call::Cancel(cancel) => {
                Ok(Reply::Cancel(CancelReply { planning: self.thread.cancel(cancel.plan), ..CancelReply::default() }))
            }
            Call::World(_) => {
                let objects = lock(&self.objects).values().cloned().collect();
                Ok(Reply::World(WorldReport { objects }))
            }
            Call::WorldAdd(WorldAdd(object)) => self.put(object).await.map(Reply::WorldAdd),
            Call::ArmToolSet(call) => self.set_tool(&call).map(Reply::ArmToolSet),
            Call::WorldMove(call) => self.move_to(&call).map(Reply::WorldMove),
            Call::WorldRemove(call) => self.remove(call.name.as_deref()).map(Reply::WorldRemove),
            Call::Attach(call) => self.attach(&call, moment).map(Reply::Attach),
            Call::Detach(call) => self.detach(&call.name, moment).map(Reply::Detach),
            _ => Err(internal()),
        }
    }

    /// Replaces the tool of a robot; `arm` is the robot's name.
    fn set_tool(&self, call: &ArmToolSet) -> Result<ArmToolReply, RpcError> {
        let robot = robot_index(self.thread.setup(), &call.arm)?;
        self.thread.set_tool(robot, call.tool.as_ref().map(isometry));
        let tcp = self.thread.now().robots.get(robot).map(|robot| TcpModel::of(robot).report());
        Ok(ArmToolReply { arm: call.arm.clone(), tcp: tcp.ok_or_else(internal)? })
    }
}

/// Returns the robots of a planner, for its registration at a run.
pub fn registered(setup: &PlanningScene) -> Vec<RegisteredRobot> {
    let robot = |robot: &dimos_planner::planning::scene::planning_scene::PlannedRobot| RegisteredRobot {
        name: robot.config.name.clone(),
        joints: robot.config.coordinator_joints.clone(),
        task: robot.config.task.clone(),
        model: Some(TcpModel::of(robot).to_register()),
    };
    setup.robots.iter().map(robot).collect()
}

/// Returns the positions of a robot's joints [rad].
pub(in crate::runtime) fn positions_of(robot: &str, joints: &[String], moment: &Moment) -> Result<Vec<f64>, RpcError> {
    let position = |joint| moment.positions.get(joint).copied();
    joints.iter().map(position).collect::<Option<_>>().ok_or_else(|| no_state(robot))
}

/// Returns the error of a request that needs a newer state than there is.
pub(in crate::runtime) fn no_state(of: &str) -> RpcError {
    RpcError::new(Code::StartStateUnavailable, format!("{of}: no state that is younger than 1 s"))
        .hint("`dimos status` shows what the arm waits for")
}

/// Runs work of the planner on another thread: neither reading files nor a panic may delay other requests, above all
/// `stop`.
pub(in crate::runtime) async fn run_blocking<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, RpcError> {
    let failed = |_| RpcError::new(Code::Internal, "the planner failed at this request: a defect of the program");
    tokio::task::spawn_blocking(work).await.map_err(failed)
}

pub(in crate::runtime) fn robot_index(setup: &PlanningScene, name: &str) -> Result<usize, RpcError> {
    let names: Vec<&str> = setup.robots.iter().map(|robot| robot.config.name.as_str()).collect();
    setup.robot(name).ok_or_else(|| RpcError::unknown(Code::UnknownRobot, "planned arm", name, &names))
}

pub(in crate::runtime) fn isometry(spec: &PoseSpec) -> Isometry3<f64> {
    pose::from_written(spec.xyz, spec.quat, spec.rpy)
}

pub(in crate::runtime) fn spec(pose: &Isometry3<f64>) -> PoseSpec {
    let q = pose.rotation.coords;
    PoseSpec { xyz: pose.translation.vector.into(), rpy: None, quat: Some([q.x, q.y, q.z, q.w]) }
}
