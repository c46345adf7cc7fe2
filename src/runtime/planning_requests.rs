//! What rpc asks of the planner: translated to the planner's words, and its plans handed to the coordinator.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

use super::dispatch::lock;
use super::service::Service;
use crate::collision::world::Attached;
use crate::planning::config::{ObjectConfig, ObjectShape, PlannerConfig};
use crate::planning::desk::{Desk, Job, Progress};
use crate::planning::path::length;
use crate::planning::setup::{Setup, obstacle};
use crate::planning::solve::{Found, Goal, Request};
use crate::robot::kinematics::pose;
use crate::rpc::api::{self, Done, PlanSummary, PoseSpec, Reply, Request as Call, ShapeSpec, WorldObject};
use crate::rpc::{Code, RpcError};

/// A state older than this is no place to plan from.
const FRESH: Duration = Duration::from_secs(1);

/// The planner of a run.
pub struct PlannerPort {
    desk: Desk,
    /// The objects of the world, as they were given.
    objects: Mutex<BTreeMap<String, WorldObject>>,
    /// The plan that was handed to the coordinator last, and its motion.
    executed: Mutex<Option<(u64, u64)>>,
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
                Ok(Reply::World(api::WorldReport { objects }))
            }
            Call::WorldAdd(api::WorldAdd(object)) => put(port, object).map(Reply::WorldAdd),
            Call::WorldMove(call) => {
                let mut object = named(port, &call.name)?;
                object.pose = call.pose;
                put(port, object).map(Reply::WorldMove)
            }
            Call::WorldRemove(call) => remove(port, call.name.as_deref()).map(Reply::WorldRemove),
            Call::Attach(call) => self.attach(port, &call).map(Reply::Attach),
            Call::Detach(call) => self.detach(port, &call.name).map(Reply::Detach),
            _ => Err(super::service::internal()),
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

    fn begin_plan(&self, port: &PlannerPort, plan: &api::Plan) -> Result<api::PlanReply, RpcError> {
        let setup = port.desk.setup();
        let goals = plan.goals.iter().map(|goal| goal_of(setup, goal)).collect::<Result<Vec<_>, _>>()?;
        let positions = self.robot_positions(setup)?;
        let request = Request { goals, positions, speed: plan.speed, seed: plan.seed };
        let id = self.parts.dispatcher.number();
        port.desk
            .begin(id, request, plan.timeout.map(Duration::from_secs_f64))
            .map_err(|busy| RpcError::new(Code::Planning, busy.to_string()).hint("wait for it, or `dimos cancel`"))?;
        Ok(api::PlanReply { plan: id })
    }

    /// Where every robot of the planner is [rad]: where it is commanded to be, where positions are commanded.
    fn robot_positions(&self, setup: &Setup) -> Result<Vec<Vec<f64>>, RpcError> {
        setup.robots.iter().map(|robot| self.positions_of(&robot.config.coordinator_joints)).collect()
    }

    fn positions_of(&self, joints: &[String]) -> Result<Vec<f64>, RpcError> {
        let now = self.now();
        let position = |name: &String| {
            let arms = self.parts.names.arms.iter().enumerate();
            let place = { arms }.find_map(|(a, arm)| Some((a, arm.joints.iter().position(|j| j == name)?)));
            let (arm, joint) = place.ok_or_else(super::service::internal)?;
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
            values.get(joint).copied().ok_or_else(super::service::internal)
        };
        joints.iter().map(position).collect()
    }

    fn preview(&self, port: &PlannerPort, plan: Option<u64>) -> Result<api::PreviewReply, RpcError> {
        let (job, found) = found(port, plan)?;
        let setup = port.desk.setup();
        let mut end_effectors = BTreeMap::new();
        let mut first = 0;
        for &index in &found.robots {
            let Some(robot) = setup.robots.get(index) else { continue };
            let kinematics = &robot.body.kinematics;
            let mut frames = kinematics.frames();
            let place = |point: &crate::trajectory::TrajectoryPoint, frames: &mut Vec<_>| {
                let own = point.positions.get(first..first + robot.joints.len()).unwrap_or_default();
                kinematics.forward_from(&robot.body.base, own, frames);
                kinematics.link_frame(robot.end_effector, frames).translation.to_array()
            };
            let way = found.trajectory.points.iter().map(|point| place(point, &mut frames)).collect();
            end_effectors.insert(robot.config.name.clone(), way);
            first += robot.joints.len();
        }
        let summary = summary(&job, &found);
        Ok(api::PreviewReply { plan: job.id, summary, trajectory: travelling(&found), end_effectors })
    }

    async fn execute_plan(&self, port: &PlannerPort, plan: Option<u64>) -> Result<Reply, RpcError> {
        let (job, found) = found(port, plan)?;
        let setup = port.desk.setup();
        let mut tasks: Vec<_> = found.robots.iter().filter_map(|&r| setup.robots.get(r)?.config.task.clone()).collect();
        tasks.dedup();
        // Several robots move in one trajectory: one task must have the joints of all.
        let task = if let [task] = tasks.as_slice() { Some(task.clone()) } else { None };
        let reply = self.execute(api::Execute { trajectory: travelling(&found), task }).await?;
        if let Reply::Execute(begun) = &reply {
            *lock(&port.executed) = Some((job.id, begun.motion));
            return Ok(Reply::ExecutePlan(begun.clone()));
        }
        Ok(reply)
    }

    fn planner_report(&self, port: &PlannerPort) -> api::PlannerReport {
        let newest = port.desk.newest(false);
        let motion = lock(&port.executed).and_then(|(_, motion)| self.motion(motion).ok());
        let (state, error) = match (&newest, &motion) {
            (Some(Job { progress: Progress::Planning(_), .. }), _) => ("PLANNING", None),
            (_, Some(motion)) if !motion.done => ("EXECUTING", None),
            (Some(Job { progress: Progress::Failed(failure, _), .. }), _) if !failure.cancelled => {
                ("FAULT", Some(failure.what.clone()))
            }
            (_, Some(motion)) if motion.state == "COMPLETED" => ("COMPLETED", None),
            (_, Some(motion)) => ("FAULT", motion.error.clone()),
            _ => ("IDLE", None),
        };
        let robot = |robot: &crate::planning::setup::PlannedRobot| api::RobotReport {
            name: robot.config.name.clone(),
            end_effector_link: robot.config.end_effector_link.clone(),
            joints: robot.config.coordinator_joints.clone(),
            limits: robot.limits.iter().map(|l| [l.lower, l.upper]).collect(),
            task: robot.config.task.clone(),
            named_poses: robot.config.named_poses.clone(),
        };
        let mut always_touching: BTreeMap<String, Vec<[String; 2]>> = BTreeMap::new();
        for (name, pair) in port.always_touching() {
            always_touching.entry(name.clone()).or_default().push(pair.clone());
        }
        api::PlannerReport {
            state: state.to_owned(),
            error,
            robots: port.desk.setup().robots.iter().map(robot).collect(),
            plan: port.desk.newest(true).map(|job| job.id),
            always_touching,
        }
    }

    fn attach(&self, port: &PlannerPort, call: &api::Attach) -> Result<Done, RpcError> {
        let setup = port.desk.setup();
        let index = robot_index(setup, &call.robot)?;
        let robot = setup.robots.get(index).ok_or_else(super::service::internal)?;
        let mut object = named(port, &call.name)?;
        let link = call.link.clone().unwrap_or_else(|| robot.config.end_effector_link.clone());
        let of_link = self.link_pose(robot, &link)?;
        let at = of_link.inverse() * isometry(&object.pose);
        let solid = obstacle(&configured(&object, at)).map_err(wrong)?;
        port.desk
            .world(|world| {
                world.remove(&call.name)?;
                world.attach(Attached {
                    name: call.name.clone(),
                    robot: index,
                    link: link.clone(),
                    solids: vec![solid.solid],
                    touch_links: call.touch_links.clone(),
                    padding: object.padding,
                })
            })
            .map_err(|e| wrong(e.to_string()))?;
        object.pose = spec(&at);
        object.held_by = Some([call.robot.clone(), link]);
        lock(&port.objects).insert(call.name.clone(), object);
        Ok(Done {})
    }

    fn detach(&self, port: &PlannerPort, name: &str) -> Result<Done, RpcError> {
        let mut object = lock(&port.objects).get(name).cloned().ok_or_else(|| unknown_object(port, name))?;
        let Some([robot, link]) = object.held_by.take() else {
            return Err(RpcError::new(Code::InvalidParams, format!("nobody holds {name}")));
        };
        let setup = port.desk.setup();
        let robot = setup.robots.get(robot_index(setup, &robot)?).ok_or_else(super::service::internal)?;
        object.pose = spec(&(self.link_pose(robot, &link)? * isometry(&object.pose)));
        port.desk.world(|world| world.detach(name)).map_err(|e| wrong(e.to_string()))?;
        put(port, object)
    }

    /// Where a robot's link is now, in the frame `map`.
    fn link_pose(&self, robot: &crate::planning::setup::PlannedRobot, link: &str) -> Result<Isometry3<f64>, RpcError> {
        let names: Vec<&str> = robot.model.links.iter().map(|link| link.name.as_str()).collect();
        let index = robot.model.link_index(link);
        let index = index.ok_or_else(|| RpcError::unknown(Code::InvalidParams, "link", link, &names))?;
        let kinematics = &robot.body.kinematics;
        let mut frames = kinematics.frames();
        kinematics.forward_from(&robot.body.base, &self.positions_of(&robot.config.coordinator_joints)?, &mut frames);
        Ok(pose(&kinematics.link_frame(index, &frames)))
    }
}

fn robot_index(setup: &Setup, name: &str) -> Result<usize, RpcError> {
    let names: Vec<&str> = setup.robots.iter().map(|robot| robot.config.name.as_str()).collect();
    setup.robot(name).ok_or_else(|| RpcError::unknown(Code::UnknownRobot, "robot", name, &names))
}

fn goal_of(setup: &Setup, goal: &api::PlanGoal) -> Result<(usize, Goal), RpcError> {
    let index = robot_index(setup, &goal.robot)?;
    let config = &setup.robots.get(index).ok_or_else(super::service::internal)?.config;
    let joints = |values: &[f64]| {
        if values.len() == config.joints.len() {
            return Ok(Goal::Joints(values.to_vec()));
        }
        let what = format!("{} has {} joints, the goal {} values", config.name, config.joints.len(), values.len());
        Err(RpcError::new(Code::InvalidParams, what).hint("give one position [rad] per joint, in order"))
    };
    let goal = match (&goal.joints, &goal.named, &goal.pose) {
        (Some(values), _, _) => joints(values)?,
        (_, Some(name), _) => {
            let names: Vec<&String> = config.named_poses.keys().collect();
            let unknown = || RpcError::unknown(Code::InvalidParams, "named pose", name, &names);
            joints(config.named_poses.get(name).ok_or_else(unknown)?)?
        }
        (_, _, Some(pose)) if goal.linear => Goal::Line(isometry(pose)),
        (_, _, Some(pose)) if pose.rpy.is_none() && pose.quat.is_none() => Goal::Place(pose.xyz.into()),
        (_, _, Some(pose)) => Goal::Pose(isometry(pose)),
        _ => return Err(super::service::internal()),
    };
    Ok((index, goal))
}

fn job(port: &PlannerPort, plan: Option<u64>) -> Result<Job, RpcError> {
    let job = match plan {
        Some(id) => port.desk.job(id),
        None => port.desk.newest(true),
    };
    job.ok_or_else(|| match plan {
        Some(id) => RpcError::new(Code::UnknownPlan, format!("there is no plan {id}, or it is too long ago"))
            .hint("`dimos plan` makes one"),
        None => RpcError::new(Code::UnknownPlan, "there is no plan yet").hint("`dimos plan` makes one"),
    })
}

fn found(port: &PlannerPort, plan: Option<u64>) -> Result<(Job, Arc<Found>), RpcError> {
    let job = job(port, plan)?;
    match &job.progress {
        Progress::Found(found, _) => Ok((job.clone(), found.clone())),
        Progress::Planning(_) => Err(RpcError::new(Code::Planning, format!("plan {} is not ready yet", job.id))),
        Progress::Failed(failure, _) => {
            Err(RpcError::new(Code::UnknownPlan, format!("plan {} was not found: {}", job.id, failure.what)))
        }
    }
}

fn report(job: &Job) -> api::PlanningReport {
    let base = api::PlanningReport {
        plan: job.id,
        state: "PLANNING".to_owned(),
        elapsed: 0.0,
        error: None,
        hint: None,
        summary: None,
    };
    match &job.progress {
        Progress::Planning(since) => api::PlanningReport { elapsed: since.elapsed().as_secs_f64(), ..base },
        Progress::Found(found, took) => api::PlanningReport {
            state: "PLANNED".to_owned(),
            elapsed: took.as_secs_f64(),
            summary: Some(summary(job, found)),
            ..base
        },
        Progress::Failed(failure, took) => api::PlanningReport {
            state: if failure.cancelled { "CANCELLED" } else { "FAILED" }.to_owned(),
            elapsed: took.as_secs_f64(),
            error: Some(failure.what.clone()),
            hint: failure.hint.clone(),
            ..base
        },
    }
}

fn summary(job: &Job, found: &Found) -> PlanSummary {
    PlanSummary {
        joints: found.trajectory.joint_names.clone(),
        start: found.path.first().cloned().unwrap_or_default(),
        goal: found.path.last().cloned().unwrap_or_default(),
        waypoints: found.path.len(),
        length: length(&found.path),
        duration: found.trajectory.duration(),
        clearance: found.clearance.as_ref().map(|(distance, _)| *distance),
        closest: found.clearance.as_ref().map(|(_, pair)| pair.clone()),
        fraction: found.fraction,
        seed: job.request.seed,
        times: found.times.clone(),
    }
}

/// The trajectory as rpc has it.
fn travelling(found: &Found) -> api::Trajectory {
    let point = |point: &crate::trajectory::TrajectoryPoint| api::Point {
        time_from_start: point.time_from_start,
        positions: point.positions.clone(),
        velocities: Some(point.velocities.clone()).filter(|v| !v.is_empty()),
        accelerations: Some(point.accelerations.clone()).filter(|a| !a.is_empty()),
    };
    api::Trajectory {
        joint_names: found.trajectory.joint_names.clone(),
        points: found.trajectory.points.iter().map(point).collect(),
    }
}

fn wrong(what: impl Into<String>) -> RpcError {
    RpcError::new(Code::InvalidParams, what)
}

fn unknown_object(port: &PlannerPort, name: &str) -> RpcError {
    let names: Vec<String> = lock(&port.objects).keys().cloned().collect();
    RpcError::unknown(Code::UnknownObject, "object", name, &names)
}

/// An object that nobody holds.
fn named(port: &PlannerPort, name: &str) -> Result<WorldObject, RpcError> {
    let object = lock(&port.objects).get(name).cloned();
    match object {
        None => Err(unknown_object(port, name)),
        Some(WorldObject { held_by: Some([robot, _]), .. }) => {
            Err(wrong(format!("{robot} holds {name}")).hint(format!("`dimos world detach {name}` lets go of it")))
        }
        Some(object) => Ok(object),
    }
}

fn put(port: &PlannerPort, object: WorldObject) -> Result<Done, RpcError> {
    if lock(&port.objects).get(&object.name).is_some_and(|other| other.held_by.is_some()) {
        named(port, &object.name)?;
    }
    let made = obstacle(&configured(&object, isometry(&object.pose))).map_err(wrong)?;
    port.desk.world(|world| world.put(made)).map_err(|e| wrong(e.to_string()))?;
    lock(&port.objects).insert(object.name.clone(), object);
    Ok(Done {})
}

fn remove(port: &PlannerPort, name: Option<&str>) -> Result<Done, RpcError> {
    let mut gone: Vec<String> = Vec::new();
    match name {
        Some(name) => gone.push(named(port, name)?.name),
        None => gone.extend(lock(&port.objects).values().filter(|o| o.held_by.is_none()).map(|o| o.name.clone())),
    }
    for name in gone {
        port.desk.world(|world| world.remove(&name)).map_err(|e| wrong(e.to_string()))?;
        lock(&port.objects).remove(&name);
    }
    Ok(Done {})
}

fn isometry(spec: &PoseSpec) -> Isometry3<f64> {
    let [x, y, z] = spec.xyz;
    let rotation = match (spec.quat, spec.rpy) {
        (Some([x, y, z, w]), _) => UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)),
        (None, Some([roll, pitch, yaw])) => UnitQuaternion::from_euler_angles(roll, pitch, yaw),
        (None, None) => UnitQuaternion::identity(),
    };
    Isometry3::from_parts(Translation3::new(x, y, z), rotation)
}

fn spec(pose: &Isometry3<f64>) -> PoseSpec {
    let q = pose.rotation.coords;
    PoseSpec { xyz: pose.translation.vector.into(), rpy: None, quat: Some([q.x, q.y, q.z, q.w]) }
}

fn configured(object: &WorldObject, pose: Isometry3<f64>) -> ObjectConfig {
    let shape = match &object.shape {
        ShapeSpec::Box(size) => ObjectShape::Box(*size),
        ShapeSpec::Sphere(radius) => ObjectShape::Sphere(*radius),
        ShapeSpec::Cylinder(size) => ObjectShape::Cylinder(*size),
        ShapeSpec::Mesh(path) => ObjectShape::Mesh(PathBuf::from(path)),
        ShapeSpec::Cloud(path) => ObjectShape::Cloud(PathBuf::from(path)),
    };
    ObjectConfig { name: object.name.clone(), shape, pose, padding: object.padding }
}

/// An object of the blueprint, as rpc has it.
fn typed(object: &ObjectConfig) -> WorldObject {
    let shape = match &object.shape {
        ObjectShape::Box(size) => ShapeSpec::Box(*size),
        ObjectShape::Sphere(radius) => ShapeSpec::Sphere(*radius),
        ObjectShape::Cylinder(size) => ShapeSpec::Cylinder(*size),
        ObjectShape::Mesh(path) => ShapeSpec::Mesh(path.display().to_string()),
        ObjectShape::Cloud(path) => ShapeSpec::Cloud(path.display().to_string()),
    };
    let pose = spec(&object.pose);
    WorldObject { name: object.name.clone(), shape, pose, padding: object.padding, held_by: None }
}
