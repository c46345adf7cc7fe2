//! Plans, over rpc: started, queried, and passed to the coordinator.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use glamx::DAffine3;
use nalgebra::Isometry3;

use super::PlannerPort;
use super::planner_port::{isometry, no_state, positions_of, robot_index, run_blocking};
use crate::runtime::internal;
use crate::runtime::tool::tcp::TcpModel;
use dimos_core::trajectory::{Cursor, JointTrajectory, Sample, Spline, TrajectoryPoint};
use dimos_planner::collision::Stop;
use dimos_planner::planning::ik::reach::Reached;
use dimos_planner::planning::request::joint_path::JointPath;
use dimos_planner::planning::request::pipeline::{Goal, PlanRequest, PlannedMotion};
use dimos_planner::planning::request::planner_thread::{BeginError, Job, Progress};
use dimos_planner::planning::scene::padded::PaddingException;
use dimos_planner::planning::scene::planning_scene::{PlannedRobot, PlanningScene};
use dimos_planner::planning::search::level::Level;
use dimos_planner::planning::search::path::length;
use dimos_robot::kinematics::{frame, pose};
use dimos_rpc::api::{self, ExecutePlan, Moment, PlanLevel, PlanSummary, ReleasedPlan};
use dimos_rpc::report::ToolReport;
use dimos_rpc::{Code, RpcError};

/// Timeout for checking whether a plan is still collision-free; after that it is not executed.
const REVIEW_LIMIT: Duration = Duration::from_secs(2);
/// Maximum number of samples of a preview: a reply of a few megabytes.
const MAX_SAMPLES: f64 = 20_000.0;

impl PlannerPort {
    pub(in crate::runtime) fn begin_plan(&self, plan: &api::Plan, moment: &Moment) -> Result<api::PlanReply, RpcError> {
        self.measured(moment);
        let scene = self.thread.now();
        let goals = plan.goals.iter().map(|goal| self.goal_of(&scene, goal, moment)).collect::<Result<Vec<_>, _>>()?;
        let positions = all_positions(&scene, moment)?;
        let waypoint = |goal| Ok(vec![self.goal_of(&scene, goal, moment)?]);
        let through = plan.through.iter().map(waypoint).collect::<Result<Vec<_>, RpcError>>()?;
        let api::Plan { speed, seed, refine, blend, tcp_speed, by_number, .. } = *plan;
        let level = Level::of_name(plan.level.name()).ok_or_else(internal)?;
        let touch = plan.touch.clone();
        let request =
            PlanRequest { goals, positions, speed, seed, level, refine, through, blend, tcp_speed, touch, by_number };
        let id = moment.plan;
        self.thread.begin(id, request, plan.timeout.map(Duration::from_secs_f64)).map_err(|why| {
            let error = RpcError::new(Code::Planning, why.to_string());
            match why {
                BeginError::Busy => error.hint("wait for it, or `dimos cancel`"),
                BeginError::Hangs => error.hint("start the planner again"),
            }
        })?;
        Ok(api::PlanReply { plan: id })
    }

    fn goal_of(&self, scene: &PlanningScene, goal: &api::PlanGoal, moment: &Moment) -> Result<(usize, Goal), RpcError> {
        let index = robot_index(scene, &goal.robot)?;
        let robot = scene.robots.get(index).ok_or_else(internal)?;
        let config = &robot.config;
        let positions = |values: &[f64]| {
            if values.len() == config.joints.len() {
                return Ok(values.to_vec());
            }
            let what = format!("{} has {} joints, the goal {} values", config.name, config.joints.len(), values.len());
            Err(RpcError::new(Code::InvalidParams, what).hint("give one position [rad] per joint, in order"))
        };
        let joints = |values: &[f64]| positions(values).map(Goal::Joints);
        let any_turn = goal.pose.is_some_and(|pose| pose.rpy.is_none() && pose.quat.is_none());
        if let Some(path) = &goal.path {
            let points = path.points.iter().map(|q| positions(q)).collect::<Result<_, RpcError>>()?;
            return Ok((index, Goal::Path(JointPath { points, tolerance: path.tolerance })));
        }
        if let Some(retrace) = &goal.retrace {
            let points = retrace.iter().map(|q| positions(q)).collect::<Result<_, RpcError>>()?;
            return Ok((index, Goal::Retrace(points)));
        }
        let goal = match (&goal.joints, &goal.named, self.goal_pose(robot, goal, moment)?) {
            (Some(values), _, _) => joints(values)?,
            (_, Some(name), _) => {
                let names: Vec<&String> = config.named_poses.keys().collect();
                let unknown = || RpcError::unknown(Code::InvalidParams, "pose", name, &names);
                joints(config.named_poses.get(name).ok_or_else(unknown)?)?
            }
            (_, _, Some(pose)) if goal.linear || goal.via.is_some() => {
                // On a line or an arc, any orientation is the present one.
                let turn = if any_turn { self.tcp_in_map(robot, moment)?.rotation } else { pose.rotation };
                let to = Isometry3::from_parts(pose.translation, turn);
                match goal.via {
                    Some(xyz) => {
                        let place = |_: &api::PoseSpec| api::PoseSpec { xyz, rpy: None, quat: None };
                        let via = api::PlanGoal {
                            pose: goal.pose.as_ref().map(place),
                            by: goal.by.as_ref().map(place),
                            ..goal.clone()
                        };
                        let via = self.goal_pose(robot, &via, moment)?.ok_or_else(internal)?;
                        Goal::Arc { via: via.translation.vector, to }
                    }
                    None => Goal::Line(to),
                }
            }
            (_, _, Some(pose)) if any_turn => Goal::Position(pose.translation.vector),
            (_, _, Some(pose)) => Goal::Pose(pose),
            _ => return Err(internal()),
        };
        Ok((index, goal))
    }

    pub(in crate::runtime) fn preview(&self, call: &api::Preview) -> Result<api::PreviewReply, RpcError> {
        let (job, found) = found(self, call.plan)?;
        let mut trajectory = found.trajectory.clone();
        if let Some(hz) = call.hz {
            trajectory.points = samples(&trajectory, hz)?;
        }
        let setup = self.thread.now();
        let (mut end_effectors, mut orientations, mut tcps) = (BTreeMap::new(), BTreeMap::new(), BTreeMap::new());
        let mut first = 0;
        for &index in &found.robots {
            let Some(robot) = setup.robots.get(index) else { continue };
            let own = |point: &TrajectoryPoint| {
                let own = point.positions.get(first..first + robot.joints.len()).unwrap_or_default();
                robot.tcp_pose(own)
            };
            let poses: Vec<_> = trajectory.points.iter().map(own).collect();
            let name = &robot.config.name;
            end_effectors.insert(name.clone(), poses.iter().map(|pose| pose.translation.to_array()).collect());
            if call.hz.is_some() {
                let turn = |at: &DAffine3| <[f64; 4]>::from(pose(at).rotation.coords);
                orientations.insert(name.clone(), poses.iter().map(turn).collect());
            }
            tcps.insert(name.clone(), TcpModel::of(robot).report());
            first += robot.joints.len();
        }
        let mut ignored_pairs: BTreeMap<String, Vec<[String; 2]>> = BTreeMap::new();
        for pair in &found.ignored {
            ignored_pairs.entry(pair.reason.clone()).or_default().push(pair.links.clone());
        }
        let (plan, summary, trajectory) = (job.id, summary(&job, &found), api_trajectory(trajectory));
        Ok(api::PreviewReply { plan, summary, ignored_pairs, trajectory, end_effectors, orientations, tcps })
    }

    /// Solves the inverse kinematics of a pose, on another thread.
    pub(in crate::runtime) async fn ik(&self, call: api::Ik, moment: &Moment) -> Result<api::IkReply, RpcError> {
        self.measured(moment);
        let scene = self.thread.now();
        let robot = robot_index(&scene, &call.robot)?;
        let positions = all_positions(&scene, moment)?;
        let present = positions.get(robot).cloned().unwrap_or_default();
        let dof = present.len();
        let near = call.near.unwrap_or(present);
        if near.len() != dof {
            let what = format!("{} has {dof} joints, `near` {} values", call.robot, near.len());
            return Err(RpcError::new(Code::InvalidParams, what));
        }
        let target = (frame(&isometry(&call.pose)), call.pose.rpy.is_none() && call.pose.quat.is_none());
        let stop = Stop::new(Some(Instant::now() + REVIEW_LIMIT), None);
        let reached = run_blocking(self.thread.reach(robot, positions, target, near, stop)).await?;
        Ok(match reached {
            Ok(Reached { joints, contact }) => api::IkReply { joints: Some(joints), error: contact },
            Err(failure) => api::IkReply { joints: None, error: Some(failure.what) },
        })
    }

    /// Returns a plan for the coordinator to execute, if it is still collision-free.
    pub(in crate::runtime) async fn release(
        &self,
        call: &ExecutePlan,
        moment: &Moment,
    ) -> Result<ReleasedPlan, RpcError> {
        let (job, found) = found(self, call.plan)?;
        if !found.level.proves() && !call.unproven {
            let what = format!("plan {} is not proven free of contact: it was checked at samples only", job.id);
            return Err(
                RpcError::new(Code::PlanUnproven, what).hint("plan again without --level fast, or add --unproven")
            );
        }
        let setup = self.thread.setup();
        // Several robots move in one trajectory: one task must have the joints of all.
        let tasks: Vec<_> = found.robots.iter().filter_map(|&r| setup.robots.get(r)?.config.task.as_ref()).collect();
        let task = tasks.first().filter(|task| tasks.len() == found.robots.len() && tasks.iter().all(|t| t == *task));
        let task = task.map(|task| (*task).clone());
        let found = match call.max_speed.filter(|most| *most < job.request.speed) {
            Some(most) => {
                let trajectory = found.trajectory.scaled(most / job.request.speed);
                Arc::new(PlannedMotion { trajectory, ..(*found).clone() })
            }
            None => found,
        };
        self.measured(moment);
        let version = self.thread.version();
        self.still_free(&job, &found, moment).await?;
        self.remember(job.id, found.clone(), version);
        Ok(ReleasedPlan { plan: job.id, trajectory: api_trajectory(found.trajectory.clone()), task })
    }

    /// Checks a plan again: the world may have changed, or a robot that it does not move may have moved.
    async fn still_free(&self, job: &Job, found: &Arc<PlannedMotion>, moment: &Moment) -> Result<(), RpcError> {
        let positions = all_positions(self.thread.setup(), moment)?;
        let stop = Stop::new(Some(Instant::now() + REVIEW_LIMIT), None);
        run_blocking(self.thread.revalidate(found.clone(), positions, stop)).await?.map_err(|failure| {
            let what = format!("plan {} is no longer free: {}", job.id, failure.what);
            RpcError::new(Code::PlanOutdated, what).hint("plan again: the world is not as it was")
        })
    }

    /// Returns the planner's report. The run adds the progress of a motion.
    pub(in crate::runtime) fn report(&self) -> api::PlannerReport {
        let (state, error) = match &self.thread.newest() {
            Some(Job { progress: Progress::Planning(_), .. }) => ("PLANNING", None),
            Some(Job { progress: Progress::Failed(failure, _), .. }) if !failure.cancelled => {
                ("FAULT", Some(failure.what.clone()))
            }
            _ => ("IDLE", None),
        };
        let robot = |robot: &PlannedRobot| api::RobotReport {
            name: robot.config.name.clone(),
            end_effector_link: robot.config.end_effector_link.clone(),
            tool: robot.config.tool.as_ref().map(ToolReport::from),
            joints: robot.config.coordinator_joints.clone(),
            limits: robot
                .limits
                .iter()
                .map(|l| [l.lower, l.upper].map(|q| Some(q).filter(|q| q.is_finite())))
                .collect(),
            task: robot.config.task.clone(),
            named_poses: robot.config.named_poses.clone(),
        };
        let mut always_touching: BTreeMap<String, Vec<[String; 2]>> = BTreeMap::new();
        for (name, pair) in &self.thread.setup().always_touching {
            always_touching.entry(name.clone()).or_default().push(pair.clone());
        }
        api::PlannerReport {
            state: state.to_owned(),
            error,
            robots: self.thread.now().robots.iter().map(robot).collect(),
            plan: self.thread.newest_without_number().map(|job| job.id),
            always_touching,
        }
    }
}

/// Returns the positions of every robot [rad], in the order of the scene. Joints that others move must be known, too:
/// a plan would be about a robot that is elsewhere.
pub(in crate::runtime) fn all_positions(setup: &PlanningScene, moment: &Moment) -> Result<Vec<Vec<f64>>, RpcError> {
    let positions = |robot: &PlannedRobot| {
        if let Some((_, lost)) = robot.moved_by_others().find(|(_, ours)| !moment.positions.contains_key(*ours)) {
            return Err(no_state(&format!("{lost}, which moves {}", robot.config.name)));
        }
        positions_of(&robot.config.name, &robot.config.coordinator_joints, moment)
    };
    setup.robots.iter().map(positions).collect()
}

pub(in crate::runtime) fn job(port: &PlannerPort, plan: Option<u64>) -> Result<Job, RpcError> {
    let job = match plan {
        Some(id) => port.thread.job(id),
        None => port.thread.newest_without_number(),
    };
    job.ok_or_else(|| {
        let (code, what) = match plan {
            Some(id) => (Code::UnknownPlan, format!("there is no plan {id}, or it is too long ago")),
            None if port.thread.newest().is_some() => {
                (Code::NoPlan, "there is no plan: the plan of a `move` is executed by that move only".to_owned())
            }
            None => (Code::NoPlan, "there is no plan yet".to_owned()),
        };
        RpcError::new(code, what).hint("`dimos plan` makes one")
    })
}

pub(in crate::runtime) fn found(port: &PlannerPort, plan: Option<u64>) -> Result<(Job, Arc<PlannedMotion>), RpcError> {
    let job = job(port, plan)?;
    match &job.progress {
        Progress::Found(found, _) => Ok((job.clone(), found.clone())),
        Progress::Planning(_) => Err(RpcError::new(Code::Planning, format!("plan {} is not ready yet", job.id))),
        Progress::Failed(failure, _) => {
            let what = format!("plan {} was not found: {}", job.id, failure.what);
            Err(RpcError::new(Code::NoPlan, what).hint("plan again; `--plan N` executes an earlier plan"))
        }
    }
}

pub(in crate::runtime) fn report(job: &Job) -> api::PlanningReport {
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

fn summary(job: &Job, found: &PlannedMotion) -> PlanSummary {
    PlanSummary {
        joints: found.trajectory.joint_names.clone(),
        start: found.path.first().cloned().unwrap_or_default(),
        goal: found.path.last().cloned().unwrap_or_default(),
        waypoints: found.path.len(),
        length: length(&found.path),
        duration: found.trajectory.duration(),
        passes: found.passes.clone(),
        level: level(found.level),
        clearance: found.clearance.as_ref().map(|clearance| clearance.distance),
        closest: found.clearance.as_ref().and_then(|clearance| clearance.pair.clone()),
        padding: found.padding,
        padding_given_up: found.exceptions.iter().map(exception).collect(),
        goal_clamped: found.clamped.iter().map(clamped).collect(),
        fraction: found.fraction,
        seed: job.request.seed,
        times: found.times.clone(),
    }
}

fn level(level: Level) -> PlanLevel {
    match level {
        Level::Fast => PlanLevel::Fast,
        Level::Certified => PlanLevel::Certified,
        Level::Exact => PlanLevel::Exact,
    }
}

fn exception(exception: &PaddingException) -> api::PaddingGivenUp {
    let PaddingException { near, link, other, distance, .. } = exception;
    let (near, link, other) = (near.name().to_owned(), link.clone(), other.clone());
    api::PaddingGivenUp { near, link, other, distance: *distance }
}

fn clamped((joint, requested, used): &(String, f64, f64)) -> api::GoalClamped {
    api::GoalClamped { joint: joint.clone(), requested: *requested, used: *used }
}

/// Samples a trajectory at a rate [Hz], its end included.
fn samples(trajectory: &JointTrajectory, hz: f64) -> Result<Vec<TrajectoryPoint>, RpcError> {
    let spline = Spline::new(trajectory).map_err(|e| RpcError::new(Code::InvalidTrajectory, e.to_string()))?;
    let count = (spline.duration() * hz).ceil();
    if count > MAX_SAMPLES {
        let what = format!("{:.1} s at {hz} Hz are {count} samples (limit {MAX_SAMPLES})", spline.duration());
        return Err(RpcError::new(Code::InvalidParams, what).hint("ask for a lower rate"));
    }
    let (mut cursor, mut at) = (Cursor::default(), vec![Sample::default(); spline.joints()]);
    let mut point = |time_from_start: f64| {
        spline.sample(time_from_start, &mut cursor, &mut at);
        let list = |value: fn(&Sample) -> f64| at.iter().map(value).collect();
        TrajectoryPoint {
            time_from_start,
            positions: list(|s| s.position),
            velocities: list(|s| s.velocity),
            accelerations: list(|s| s.acceleration),
        }
    };
    Ok((0..=count as u32).map(|k| point((f64::from(k) / hz).min(spline.duration()))).collect())
}

/// Converts a trajectory to its rpc type.
fn api_trajectory(trajectory: JointTrajectory) -> api::Trajectory {
    let point = |point: TrajectoryPoint| api::Point {
        time_from_start: point.time_from_start,
        positions: point.positions.into_vec(),
        velocities: Some(point.velocities.into_vec()).filter(|v| !v.is_empty()),
        accelerations: Some(point.accelerations.into_vec()).filter(|a| !a.is_empty()),
    };
    api::Trajectory { joint_names: trajectory.joint_names, points: trajectory.points.into_iter().map(point).collect() }
}
