//! Planning: its requests, the planner in this process or another, the world, poses, and paths that are checked again.

pub(in crate::runtime) mod attached;
pub(in crate::runtime) mod goal_frames;
pub(in crate::runtime) mod guard_worlds;
pub(in crate::runtime) mod model_requests;
pub(in crate::runtime) mod plan_requests;
pub(in crate::runtime) mod planner_link;
pub(in crate::runtime) mod planner_port;
pub(in crate::runtime) mod recheck;
pub(in crate::runtime) mod saved_poses;
pub(in crate::runtime) mod world_requests;

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::Instant;

use nalgebra::Isometry3;

use super::tool::tcp::TcpModel;
use dimos_core::sync::lock;
use dimos_core::telemetry::Origin;
use dimos_planner::planning::request::planner_thread::PlannerThread;
use dimos_rpc::api::{Plan, RegisteredRobot, WorldObject};
use dimos_rpc::server::planner_proxy::PlannerProxy;
use guard_worlds::GuardWorlds;
use recheck::Released;

/// Maximum number of requests for plans kept.
const REMEMBERED: usize = 64;

/// A planner.
pub struct PlannerPort {
    thread: PlannerThread,
    /// When the run last sent the positions of its arms.
    measured: Mutex<Option<Instant>>,
    /// The objects of the world, as they were given.
    objects: Mutex<BTreeMap<String, WorldObject>>,
    /// The plans that were executed, by number.
    released: Mutex<BTreeMap<u64, Released>>,
}

/// A planner in another process.
struct Attached {
    name: String,
    robots: Vec<RegisteredRobot>,
    /// The models of the robots, with their present tools.
    models: Mutex<Vec<TcpModel>>,
    line: Arc<PlannerProxy>,
}

/// The planner of a run, and what was asked of it.
pub(in crate::runtime) struct Plans {
    /// The planner in this process.
    port: Option<PlannerPort>,
    /// The collision guard of streams.
    guard: Option<Arc<GuardWorlds>>,
    /// The attached planner, also after it disconnected.
    attached: Mutex<Option<Arc<Attached>>>,
    /// The last executed plan, and its motion.
    executed: Mutex<Option<(u64, u64)>>,
    /// Requests of plans, by the plans' numbers.
    requests: Mutex<BTreeMap<u64, (Plan, Origin)>>,
}

impl Plans {
    pub fn new(port: Option<PlannerPort>, guard: Option<Arc<GuardWorlds>>) -> Self {
        Self { port, guard, attached: Mutex::default(), executed: Mutex::default(), requests: Mutex::default() }
    }

    /// Returns the planner in this process.
    pub fn port(&self) -> Option<&PlannerPort> {
        self.port.as_ref()
    }

    /// Returns the models of the planner's robots, with their present tools.
    pub fn models(&self) -> Vec<TcpModel> {
        match (&self.port, &*lock(&self.attached)) {
            (Some(port), _) => port.thread.now().robots.iter().map(TcpModel::of).collect(),
            (None, Some(attached)) => lock(&attached.models).clone(),
            (None, None) => Vec::new(),
        }
    }

    /// Replaces the tool in the model of an attached planner's robot.
    pub fn set_attached_tool(&self, robot: &str, tool: Option<Isometry3<f64>>) {
        let attached = lock(&self.attached).clone();
        if let Some(attached) = attached {
            let mut models = lock(&attached.models);
            models.iter_mut().filter(|m| m.robot.as_deref() == Some(robot)).for_each(|model| model.tool = tool);
        }
    }

    /// Keeps the request of a plan, and its origin.
    fn remember(&self, plan: u64, request: Plan, origin: Origin) {
        let mut requests = lock(&self.requests);
        while requests.len() >= REMEMBERED {
            requests.pop_first();
        }
        requests.insert(plan, (request, origin));
    }

    /// Returns the request of a plan.
    pub fn request(&self, plan: u64) -> Option<Plan> {
        lock(&self.requests).get(&plan).map(|(request, _)| request.clone())
    }

    /// Limits the speed of a plan from now on, also if it is planned again. Returns the epoch of its request.
    fn slow_down(&self, plan: u64, most: Option<f64>) -> Option<u64> {
        lock(&self.requests).get_mut(&plan).map(|(request, planned)| {
            request.speed = most.map_or(request.speed, |most| request.speed.min(most));
            planned.epoch
        })
    }
}
