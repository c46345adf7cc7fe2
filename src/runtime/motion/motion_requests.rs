//! Requests for motions: finds the task, checks every limit, passes the motion to the tick.

use std::sync::Arc;
use std::time::Duration;

use serde_json::json;

use super::motions::{Carried, Planned};
use super::until::awaited;
use crate::runtime::client::asker::asker;
use crate::runtime::client::curb::curb;
use crate::runtime::plan::planner_port::run_blocking;
use crate::runtime::{Service, internal};
use dimos_control::point_to_point::{MotionError, point_to_point};
use dimos_control::request::Motion;
use dimos_control::task_body::TargetKind;
use dimos_core::joint::{JointBounds, JointLimits};
use dimos_core::telemetry::{Origin, Outcome};
use dimos_core::trajectory::{JointTrajectory, Spline, TrajectoryPoint};
use dimos_core::written;
use dimos_planner::planning::curve::{self, fit::fit, settings::CurveSettings};
use dimos_planner::planning::request::joint_path::{JointPath, Outside};
use dimos_planner::planning::search::path::{distance, length};
use dimos_planner::planning::timing::settings::TimingSettings;
use dimos_planner::planning::timing::time_within;
use dimos_rpc::api::{self, Reply};
use dimos_rpc::{Code, RpcError};

/// Trajectories may exceed a velocity or acceleration limit by this factor, for rounding in files.
const SLACK: f64 = 1.001;
/// Maximum velocity at the first and last point of a trajectory [rad/s].
const REST: f64 = 1e-3;

/// The plan that a motion executes, and whether it is planned again: see [`Carried::replan`].
pub(in crate::runtime) type Carries = (u64, Option<Option<api::Presence>>);

impl Service {
    /// Returns the trajectory task that covers these joints and the fewest others.
    pub(in crate::runtime) fn trajectory_task(&self, joints: &[u16]) -> Result<u16, RpcError> {
        let tasks = self.facts.blueprint.tasks.iter().enumerate();
        let fitting = |(_, t): &(usize, &crate::blueprint::Task)| {
            t.spec.takes(TargetKind::Trajectory) && joints.iter().all(|&j| t.joints.contains(&j.into()))
        };
        match tasks.filter(fitting).min_by_key(|(_, t)| t.joints.len()) {
            Some((i, _)) => Ok(i as u16),
            None => Err(RpcError::new(Code::NoTrajectoryTask, "no trajectory task covers these joints")
                .hint("add one to the blueprint: `tasks: [{name: traj_arm, type: trajectory, …}]`")),
        }
    }

    pub(in crate::runtime) async fn move_arm(&self, call: api::Move, origin: Origin) -> Result<Reply, RpcError> {
        let arm = self.facts.arm_index(&call.arm)?;
        if !call.direct {
            self.plans.needs_no_plan(&call.arm)?;
        }
        self.end_streams(&self.facts.joints_of_arm(arm).collect::<Vec<_>>()).await?;
        self.move_within(call, Duration::MAX, origin).await
    }

    /// Moves an arm, if that takes at most `longest`.
    pub(in crate::runtime) async fn move_within(
        &self,
        call: api::Move,
        longest: Duration,
        origin: Origin,
    ) -> Result<Reply, RpcError> {
        let arm = self.facts.arm_index(&call.arm)?;
        let joints: Vec<u16> = self.facts.joints_of_arm(arm).collect();
        let config = &self.facts.config.arms[arm as usize];
        let target = call.path.as_ref().and_then(|path| path.points.last()).unwrap_or(&call.target).clone();
        if target.len() != joints.len() {
            let what = format!("{} has {} joints, the target {} values", call.arm, joints.len(), target.len());
            return Err(RpcError::new(Code::InvalidParams, what).hint("give one position [rad] per joint, in order"));
        }
        let task = self.trajectory_task(&joints)?;
        let Some(view) = self.tick.arm_view(arm as usize).filter(|v| v.state.seq > 0) else {
            return self.refusal(&Outcome::StartStateUnavailable(arm)).map_or_else(|| Err(internal()), Err);
        };
        // In position mode the motion continues from the last command: the measured position sags below it.
        let from_command = view.command.mode.is_some_and(|m| m.is_position());
        let start = if from_command { view.command.values } else { view.state.position };
        let start = start.get(..config.dof).unwrap_or_default().to_vec();
        let names = self.facts.names.arms[arm as usize].joints.clone();
        let limits = capped(&config.limits, call.max_velocity, call.max_acceleration);
        let motion = match call.path {
            Some(path) => {
                let (names, start) = (names.clone(), start.clone());
                run_blocking(move || along(&names, start, path, &limits, call.speed)).await?
            }
            None => point_to_point(&names, &start, &target, &limits, call.speed),
        };
        let motion = motion.map_err(|e| match e {
            MotionError::OutOfLimits { ref joint, excess, target, .. } => {
                let data = json!({"joint": joint, "by": excess});
                let inside = "positions are in rad; limits are the arm's own, narrowed by `limits` in the blueprint; \
                              commands stay 0.01 rad inside";
                let hint = written::degrees(target).unwrap_or_else(|| inside.to_owned());
                RpcError::new(Code::OutOfLimits, e.to_string()).hint(hint).data(data)
            }
            MotionError::NotFound(_) => RpcError::new(Code::OutOfLimits, e.to_string())
                .hint("try another speed, or a slightly different target"),
        })?;
        let motion = self.within_tool_speed(&joints, motion, call.speed).await?;
        let duration = motion.duration();
        if duration > longest.as_secs_f64() {
            let what = format!("the motion would take {duration:.1} s (limit {} s)", longest.as_secs());
            return Err(RpcError::new(Code::OutOfLimits, what));
        }
        let number = self.begin(task, joints, motion, origin, None).await?;
        Ok(Reply::Move(api::MoveReply {
            motion: number,
            task: self.facts.names.task(task),
            duration,
            joints: names,
            start,
            target,
            collision_checked: false,
        }))
    }

    pub(in crate::runtime) async fn execute(&self, call: api::Execute, origin: Origin) -> Result<Reply, RpcError> {
        self.end_streams(&self.facts.joints_named(&call.trajectory.joint_names)?).await?;
        let to = call.retraces_to;
        let begun = self.execute_as(call, origin, None).await?;
        self.motions.retraces(begun.motion, to);
        Ok(Reply::Execute(begun))
    }

    /// Executes a trajectory, as the motion of a plan if it comes from one.
    pub(in crate::runtime) async fn execute_as(
        &self,
        call: api::Execute,
        origin: Origin,
        plan: Option<Carries>,
    ) -> Result<api::ExecuteReply, RpcError> {
        let trajectory = trajectory_of(call.trajectory);
        let joints = self.facts.joints_named(&trajectory.joint_names)?;
        let task = match &call.task {
            Some(name) => self.facts.task_index(name)?,
            None => self.trajectory_task(&joints)?,
        };
        let trajectory = self.within_tool_speed(&joints, trajectory, 1.0).await?;
        let duration = trajectory.duration();
        let number = self.begin(task, joints, trajectory, origin, plan).await?;
        Ok(api::ExecuteReply { motion: number, task: self.facts.names.task(task), duration })
    }

    /// Passes a trajectory to its task. Checks all of it before anything moves.
    pub(in crate::runtime) async fn begin(
        &self,
        task: u16,
        joints: Vec<u16>,
        trajectory: JointTrajectory,
        origin: Origin,
        plan: Option<Carries>,
    ) -> Result<u64, RpcError> {
        let spline = Spline::new(&trajectory).map_err(|e| RpcError::new(Code::InvalidTrajectory, e.to_string()))?;
        self.check_rest(&joints, &trajectory)?;
        self.check_limits(&joints, &spline)?;
        let number = self.tick.dispatcher().next_id();
        let goal = (0..joints.len()).map(|k| spline.goal(k)).collect();
        let plan = plan.map(|(plan, replan)| {
            let (spline, curb) = (Arc::new(spline.clone()), curb().unwrap_or_default());
            Carried { plan, spline, replan, origin, curb }
        });
        let planned = Planned {
            task,
            joints: joints.clone(),
            goal,
            duration: spline.duration(),
            plan,
            blocked: None,
            next: None,
            retraces_to: None,
            began: None,
            by: asker(),
        };
        self.motions.plan(number, planned);
        let motion = Box::new(Motion { id: number, joints, spline, until: awaited() });
        let sent = self.tick.dispatcher().execute(task, motion, Some(origin), Arc::new(trajectory));
        let result = self.outcome(sent.await);
        if result.is_err() {
            self.motions.forget(number);
        }
        result.map(|_| number)
    }

    /// Checks that a trajectory begins and ends at rest, as the arm does.
    fn check_rest(&self, joints: &[u16], trajectory: &JointTrajectory) -> Result<(), RpcError> {
        let ends = [("start", trajectory.points.first()), ("end", trajectory.points.last())];
        for (which, point) in ends.into_iter().filter_map(|(which, point)| Some((which, point?))) {
            for (&joint, velocity) in joints.iter().zip(&point.velocities) {
                if velocity.abs() > REST {
                    let name = self.facts.names.joint(joint);
                    let what = format!("{name} moves at {velocity:.3} rad/s at the {which} of the trajectory");
                    return Err(RpcError::new(Code::InvalidTrajectory, what)
                        .hint("let it begin and end with velocity 0, or leave the velocities out")
                        .data(json!({"joint": name, "by": velocity})));
                }
            }
        }
        Ok(())
    }

    /// F36: rejects a trajectory that exceeds a limit before it begins, with the joint and the amount.
    pub(in crate::runtime) fn check_limits(&self, joints: &[u16], spline: &Spline) -> Result<(), RpcError> {
        for (k, &joint) in joints.iter().enumerate() {
            let Some((arm, j)) = self.facts.locate(joint) else { continue };
            let l = &self.facts.config.arms[arm].limits;
            let bounds =
                JointBounds::inside(l.position_lower[j], l.position_upper[j], l.velocity_max[j], l.acceleration_max[j]);
            let e = spline.extremes(k);
            let name = self.facts.names.joint(joint);
            let refuse = |what: String, by: f64, hint: &str| {
                let data = json!({"joint": name.clone(), "by": by});
                Err(RpcError::new(Code::OutOfLimits, what).hint(hint.to_owned()).data(data))
            };
            let start = spline.start(k);
            let (lower, upper) = (bounds.lower.min(start), bounds.upper.max(start));
            let excess = (lower - e.lowest).max(e.highest - upper);
            if excess > 1e-6 {
                let what = format!("{name} would leave its limits {lower:.3} … {upper:.3} rad by {excess:.4} rad");
                return refuse(what, excess, "limits are the arm's own, narrowed by `limits` in the blueprint");
            }
            for (what, unit, got, most) in [
                ("velocity", "rad/s", e.fastest, bounds.velocity),
                ("acceleration", "rad/s²", e.steepest, bounds.acceleration),
            ] {
                if got > most * SLACK + 1e-9 {
                    let text = format!("{name} exceeds its {what} limit: {got:.3} {unit} (limit {most:.3} {unit})");
                    let slower = if unit == "rad/s" { got / most } else { (got / most).sqrt() };
                    let hint =
                        format!("make the trajectory {slower:.2} times as long, or raise the limit in the blueprint");
                    return refuse(text, got - most, &hint);
                }
            }
        }
        Ok(())
    }
}

/// Returns the motion straight to the first point of a path, and along it from rest to rest.
fn along(
    names: &[String],
    start: Vec<f64>,
    path: api::JointPath,
    limits: &JointLimits,
    speed: f64,
) -> Result<JointTrajectory, MotionError> {
    let list = |values: &[f64], j: usize| values.get(j).copied().unwrap_or_default();
    let ranges: Vec<[f64; 2]> = (0..names.len())
        .map(|j| JointBounds::inside(list(&limits.position_lower, j), list(&limits.position_upper, j), 1.0, 1.0))
        .map(|range| [range.lower, range.upper])
        .collect();
    let mut path = JointPath { points: path.points, tolerance: path.tolerance };
    path.clamp(&ranges).map_err(|Outside { joint, position, limits: [lower, upper], .. }| {
        MotionError::OutOfLimits {
            joint: names.get(joint).cloned().unwrap_or_default(),
            target: position,
            lower,
            upper,
            excess: (lower - position).max(position - upper),
        }
    })?;
    let bounds: Vec<JointBounds> = (0..names.len()).filter_map(|j| limits.joint(j)).collect();
    let straight = |way: &[Vec<f64>], deviation: f64| {
        let timed =
            time_within(names, way, &bounds, &vec![deviation; way.len()], &TimingSettings::default(), |_, _| true);
        timed.map(|timed| timed.trajectory).map_err(|e| MotionError::NotFound(e.to_string()))
    };
    let settings = CurveSettings::default();
    let curve = fit(&path.points, path.tolerance, &settings.fit).filter(|curve| curve.stays_inside(&ranges));
    let along = curve.and_then(|curve| curve::motion::along(names, &curve, &bounds, |_, _| 0.0, &settings.clock));
    let along = match along {
        Some(along) => Some(along),
        None if length(&path.points) > 0.0 => Some(straight(&path.points, path.tolerance)?),
        None => None,
    };
    // It rests where the path begins.
    let first = path.points.first().cloned().unwrap_or_default();
    let approach = if distance(&start, &first) > 0.0 { Some(straight(&[start, first], 0.0)?) } else { None };
    let whole = match (approach, along) {
        (Some(approach), Some(along)) => Some(curve::motion::after(approach, along)),
        (approach, along) => approach.or(along),
    };
    let whole = whole.ok_or_else(|| MotionError::NotFound("the path does not move".into()))?;
    Ok(if speed < 1.0 { whole.scaled(speed) } else { whole })
}

/// Returns the limits, with velocities [rad/s] and accelerations [rad/s²] of at most these.
fn capped(limits: &JointLimits, velocity: Option<f64>, acceleration: Option<f64>) -> JointLimits {
    let mut limits = limits.clone();
    let caps = [(&mut limits.velocity_max, velocity), (&mut limits.acceleration_max, acceleration)];
    for (values, cap) in caps {
        values.iter_mut().for_each(|value| *value = cap.map_or(*value, |cap| value.min(cap)));
    }
    limits
}

fn trajectory_of(given: api::Trajectory) -> JointTrajectory {
    let points = given.points.into_iter().map(|p| TrajectoryPoint {
        time_from_start: p.time_from_start,
        positions: p.positions.into(),
        velocities: p.velocities.unwrap_or_default().into(),
        accelerations: p.accelerations.unwrap_or_default().into(),
    });
    JointTrajectory { points: points.collect(), joint_names: given.joint_names }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn caps_narrow_the_limits_and_never_widen_them() {
        let limits = JointLimits::uniform(2, 2.0, 1.5).with_defaults();
        let [speed, acceleration] = [limits.velocity_max[0], limits.acceleration_max[0]];
        let narrow = capped(&limits, Some(speed / 2.0), Some(acceleration * 2.0));
        assert_eq!((narrow.velocity_max[1], narrow.acceleration_max[1]), (speed / 2.0, acceleration));
        assert_eq!(capped(&limits, None, None).velocity_max, limits.velocity_max);
    }
}
