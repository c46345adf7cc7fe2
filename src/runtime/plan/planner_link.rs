//! Routes requests to the run's planner, which is in this process or attached from another: adds the current state of
//! the run, limits the waiting time, and executes plans. The tick is not involved.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use serde_json::Value;

use super::planner_port::run_blocking;
use super::{Attached, PlannerPort, Plans};
use crate::blueprint::Arm;
use crate::runtime::tool::tcp::TcpModel;
use crate::runtime::{Service, internal};
use dimos_control::config::CoordinatorConfig;
use dimos_control::task_body::TargetKind;
use dimos_core::joint::{DEFAULT_JERK, JointBounds};
use dimos_core::sync::lock;
use dimos_core::telemetry::Origin;
use dimos_core::telemetry::describe::Names;
use dimos_rpc::api::{
    self, CommandLimits, ExecutePlan, Moment, PlannerReport, RECHECK, Recheck, RecheckReply, RegisterPlanner,
    Registered, ReleasedPlan, Reply, Request as Call,
};
use dimos_rpc::report::{AttachedReport, PlannerStatus};
use dimos_rpc::server::planner_proxy::{PlannerProxy, gone};
use dimos_rpc::{Code, RpcError};

/// Maximum age of a state to plan from.
const MAX_STATE_AGE: Duration = Duration::from_secs(1);
/// Timeout for a reply of an attached planner that needs no computation.
const QUERY_TIMEOUT: Duration = Duration::from_secs(3);
/// Timeout for a reply for which it reads files or checks a motion.
const SLOW_QUERY_TIMEOUT: Duration = Duration::from_secs(9);
/// Timeout for its part of `status`.
const STATUS_TIMEOUT: Duration = Duration::from_millis(500);

/// The planner of a run.
pub(super) enum Planner<'a> {
    Own(&'a PlannerPort),
    Attached(Arc<Attached>),
}

impl Planner<'_> {
    async fn answer(&self, call: Call, moment: Moment, limit: Duration) -> Result<Reply, RpcError> {
        match self {
            Self::Own(port) => port.answer(call, &moment).await,
            Self::Attached(planner) => {
                let (method, params) = call.written();
                Reply::read(method, planner.line.ask(method, params, moment, limit).await?)
            }
        }
    }

    /// Returns what blocks a planned motion that is being executed.
    pub(in crate::runtime) async fn recheck(
        &self,
        call: &Recheck,
        moment: Moment,
        limit: Duration,
    ) -> Result<RecheckReply, RpcError> {
        match self {
            Self::Own(port) => port.recheck(call, &moment).await,
            Self::Attached(planner) => {
                let params = serde_json::to_value(call).unwrap_or_default();
                let reply = planner.line.ask(RECHECK, params, moment, limit).await?;
                let unlike = |e: serde_json::Error| RpcError::new(Code::Internal, format!("reply to {RECHECK}: {e}"));
                serde_json::from_value(reply).map_err(unlike)
            }
        }
    }

    async fn release(&self, execute: &ExecutePlan, moment: Moment) -> Result<ReleasedPlan, RpcError> {
        match self {
            Self::Own(port) => port.release(execute, &moment).await,
            Self::Attached(planner) => {
                let (method, params) = Call::ExecutePlan(execute.clone()).written();
                let released = planner.line.ask(method, params, moment, SLOW_QUERY_TIMEOUT).await?;
                serde_json::from_value(released)
                    .map_err(|e| RpcError::new(Code::Internal, format!("the planner released no plan: {e}")))
            }
        }
    }
}

impl Plans {
    /// Returns the run's planner; an error without one, with data if one has disconnected.
    pub(super) fn planner(&self) -> Result<Planner<'_>, RpcError> {
        if let Some(port) = &self.port {
            return Ok(Planner::Own(port));
        }
        match &*lock(&self.attached) {
            Some(planner) if planner.line.is_closed() => Err(gone()),
            Some(planner) => Ok(Planner::Attached(planner.clone())),
            None => Err(RpcError::new(Code::NoPlanner, "this run has no planner")
                .hint("run a planner blueprint, such as yourarm-planner: beside this run, it attaches to it")),
        }
    }

    /// Refuses a motion that is not collision-checked if the run has a planner, also one that has disconnected.
    pub fn needs_no_plan(&self, arm: &str) -> Result<(), RpcError> {
        match self.planner() {
            Ok(_) => Err(RpcError::new(Code::NotPlanned, format!("a direct motion of {arm} is not collision-checked"))
                .hint("this run has a planner, and a planned motion is checked: plan and execute it; to skip the check: --direct, in rpc and Python `direct`")),
            Err(RpcError { code: Code::NoPlanner, data: None, .. }) => Ok(()),
            Err(gone) => Err(gone),
        }
    }
}

impl Service {
    /// Answers those of the planner's methods that neither make nor execute a plan.
    pub(in crate::runtime) async fn planner_call(&self, call: Call) -> Result<Reply, RpcError> {
        self.planner_call_from(call, Origin::default()).await
    }

    /// Answers the planner's methods. A plan is executed only if nothing has interrupted its arms since it was
    /// requested.
    pub(in crate::runtime) async fn planner_call_from(&self, call: Call, origin: Origin) -> Result<Reply, RpcError> {
        let planner = self.plans.planner()?;
        let limit = if matches!(call, Call::WorldAdd(_)) { SLOW_QUERY_TIMEOUT } else { QUERY_TIMEOUT };
        match call {
            Call::ExecutePlan(execute) => {
                let released = planner.release(&execute, self.moment(0)).await?;
                self.refuse_mismatch(&released.trajectory.joint_names)?;
                // A planner may release a plan that this run has not requested.
                let plan = execute.plan.unwrap_or(released.plan);
                // If it is planned again, it stays as slow.
                let planned = self.plans.slow_down(plan, execute.max_speed);
                let epoch = planned.map_or(origin.epoch, |planned| planned.min(origin.epoch));
                let origin = Origin { epoch, ..origin };
                self.end_streams(&self.facts.joints_named(&released.trajectory.joint_names)?).await?;
                let replan = execute.replan.then_some(execute.presence);
                let begun = self.execute_released(&planner, released, origin, replan).await?;
                self.motions.retraces(begun.motion, execute.retraces_to);
                Ok(Reply::ExecutePlan(begun))
            }
            Call::Planner(_) => self.planner_report(&planner, limit).await.map(Reply::Planner),
            Call::Plan(plan) => {
                let plan = self.with_saved_poses(plan).await?;
                self.refuse_mismatch(&self.joints_of_plan(&plan))?;
                let number = self.tick.dispatcher().next_id();
                let begun = planner.answer(Call::Plan(plan.clone()), self.moment(number), limit).await?;
                self.plans.remember(number, plan, origin);
                Ok(begun)
            }
            Call::WorldAdd(_) | Call::WorldMove(_) | Call::WorldRemove(_) | Call::Attach(_) | Call::Detach(_) => {
                let moment =
                    if matches!(call, Call::Attach(_) | Call::Detach(_)) { self.moment(0) } else { Moment::default() };
                let changed = planner.answer(call, moment, limit).await;
                // Also after an error or a timeout: the change may have been made.
                if let Some(guard) = self.plans.guard.clone() {
                    run_blocking(move || guard.wait()).await?;
                }
                self.recheck(&planner).await;
                changed
            }
            Call::Ik(_) => planner.answer(call, self.moment(0), limit).await,
            _ => planner.answer(call, Moment::default(), limit).await,
        }
    }

    async fn execute_released(
        &self,
        planner: &Planner<'_>,
        released: ReleasedPlan,
        origin: Origin,
        replan: Option<Option<api::Presence>>,
    ) -> Result<api::ExecuteReply, RpcError> {
        let ReleasedPlan { plan, trajectory, task } = released;
        // Data from another process is checked like that of any client.
        let execute = api::Execute { trajectory, task, retraces_to: None };
        api::Method::check(&execute).map_err(|what| RpcError::new(Code::InvalidTrajectory, what))?;
        let begun = self.execute_as(execute, origin, Some((plan, replan))).await?;
        *lock(&self.plans.executed) = Some((plan, begun.motion));
        // The world may have changed since the plan was checked.
        let under_way = self.motions.under_way().into_iter().find(|motion| motion.number == begun.motion);
        if let Some(motion) = under_way {
            self.recheck_motion(planner, &motion).await;
        }
        Ok(begun)
    }

    /// Cancels the planning of this plan; `None`: of any. Returns whether it was being planned.
    pub(in crate::runtime) async fn cancel_planning(&self, plan: Option<u64>) -> bool {
        let Ok(planner) = self.plans.planner() else { return false };
        let cancel = Call::Cancel(api::Cancel { plan, ..Default::default() });
        let cancelled = planner.answer(cancel, Moment::default(), QUERY_TIMEOUT).await;
        matches!(cancelled, Ok(Reply::Cancel(reply)) if reply.planning)
    }

    /// Returns a plan's number, by default that of the one to execute without a number, and the coordinator's joints
    /// that it moves.
    pub(in crate::runtime) async fn plan_and_its_joints(
        &self,
        plan: Option<u64>,
    ) -> Result<(u64, Vec<String>), RpcError> {
        let planner = self.plans.planner()?;
        let answer = |call| planner.answer(call, Moment::default(), QUERY_TIMEOUT);
        let number = match plan {
            Some(number) => number,
            None => match answer(Call::Planner(api::Planner {})).await? {
                Reply::Planner(PlannerReport { plan: Some(newest), .. }) => newest,
                // The planner's own words.
                _ => return answer(Call::Preview(api::Preview::default())).await.and_then(|_| Err(internal())),
            },
        };
        match answer(Call::Planning(api::Planning { plan: number })).await? {
            Reply::Planning(report) => Ok((number, report.summary.map(|s| s.joints).unwrap_or_default())),
            _ => Err(internal()),
        }
    }

    /// Returns the planner's robots.
    pub(in crate::runtime) async fn robots(&self) -> Result<Vec<api::RobotReport>, RpcError> {
        Ok(self.planner_report(&self.plans.planner()?, QUERY_TIMEOUT).await?.robots)
    }

    /// Returns the planner's report, with the progress of its last motion.
    async fn planner_report(&self, planner: &Planner<'_>, limit: Duration) -> Result<PlannerReport, RpcError> {
        let Reply::Planner(mut report) =
            planner.answer(Call::Planner(api::Planner {}), Moment::default(), limit).await?
        else {
            return Err(internal());
        };
        let motion = lock(&self.plans.executed).and_then(|(_, motion)| self.motion(motion).ok());
        let (state, error) = match (report.state.as_str(), &motion) {
            ("PLANNING", _) => return Ok(report),
            (_, Some(motion)) if !motion.done => ("EXECUTING", None),
            ("FAULT", _) | (_, None) => return Ok(report),
            (_, Some(motion)) if motion.state == "COMPLETED" => ("COMPLETED", None),
            (_, Some(motion)) => ("FAULT", motion.error.clone()),
        };
        (report.state, report.error) = (state.to_owned(), error);
        Ok(report)
    }

    /// Returns the planner's part of `status`, if there is a planner.
    pub(in crate::runtime) async fn planner_status(&self) -> Option<PlannerStatus> {
        let own = |e: &RpcError| PlannerStatus {
            state: "FAULT".into(),
            error: Some(e.message.clone()),
            ..Default::default()
        };
        let planner = match self.plans.planner() {
            Ok(planner) => planner,
            Err(_) => return None,
        };
        let mut status = match self.planner_report(&planner, STATUS_TIMEOUT).await {
            Ok(report) => PlannerStatus {
                robots: report.robots.into_iter().map(|robot| robot.name).collect(),
                state: report.state,
                error: report.error,
                attached: None,
            },
            Err(e) => own(&e),
        };
        if let Planner::Attached(planner) = planner {
            status.robots = planner.robots.iter().map(|robot| robot.name.clone()).collect();
            status.attached = Some(AttachedReport { name: planner.name.clone(), pid: planner.line.pid() });
        }
        Some(status)
    }

    /// Registers the process at the other end of a connection as this run's planner.
    pub(in crate::runtime) fn register(
        &self,
        planner: RegisterPlanner,
        line: Arc<PlannerProxy>,
    ) -> Result<Registered, RpcError> {
        let has = |whose: String| {
            RpcError::new(Code::HasPlanner, format!("run {} has a planner already: {whose}", self.facts.run))
                .hint("end that one first: a run has one planner")
        };
        if self.plans.port.is_some() {
            return Err(has("its blueprint's own".into()));
        }
        let mut models = Vec::new();
        for robot in &planner.robots {
            self.fits(robot)?;
            models.extend(TcpModel::registered(robot).map_err(|what| RpcError::new(Code::InvalidParams, what))?);
        }
        let joints = planner.robots.iter().flat_map(|robot| &robot.joints);
        let mut limits = command_limits(&self.facts.names, &self.facts.config, &self.facts.blueprint.arms);
        limits.retain(|joint, _| joints.clone().any(|j| j == joint));
        let mut attached = lock(&self.plans.attached);
        if let Some(other) = attached.as_ref().filter(|other| !other.line.is_closed()) {
            let process = other.line.pid().map(|pid| format!(" (pid {pid})")).unwrap_or_default();
            return Err(has(format!("{}{process}", other.name)));
        }
        tracing::info!("planner {} attached", planner.name);
        self.take_planner_tools(&models);
        let models = Mutex::new(models);
        *attached = Some(Arc::new(Attached { name: planner.name, robots: planner.robots, models, line }));
        *lock(&self.plans.executed) = None;
        Ok(Registered { run: self.facts.run.clone(), limits })
    }

    /// Checks that this run has the joints of a robot and the task that moves them.
    fn fits(&self, robot: &api::RegisteredRobot) -> Result<(), RpcError> {
        let all: Vec<&String> = self.facts.names.arms.iter().flat_map(|arm| &arm.joints).collect();
        let index = |name: &String| {
            let place = all.iter().position(|joint| *joint == name);
            place.ok_or_else(|| RpcError::unknown(Code::InvalidParams, "joint", name, &all))
        };
        let joints = robot.joints.iter().map(index).collect::<Result<Vec<_>, _>>()?;
        let Some(name) = &robot.task else { return Ok(()) };
        let task = &self.facts.blueprint.tasks[self.facts.task_index(name)? as usize];
        let has = |joint: &usize| task.joints.contains(joint);
        match (task.spec.takes(TargetKind::Trajectory), joints.iter().all(has)) {
            (true, true) => Ok(()),
            (true, false) => {
                let what = format!("task {name} does not have all joints of robot {}", robot.name);
                Err(RpcError::new(Code::NoTrajectoryTask, what))
            }
            _ => Err(RpcError::new(Code::WrongTask, format!("task {name} executes no trajectories"))),
        }
    }

    /// Returns the current state of the run, for a planner.
    pub(in crate::runtime) fn moment(&self, plan: u64) -> Moment {
        let (now, mut positions, mut grippers) = (self.now(), BTreeMap::new(), BTreeMap::new());
        for (index, arm) in self.facts.names.arms.iter().enumerate() {
            let fresh = |view: &dimos_core::telemetry::ArmSample| {
                view.state.seq > 0 && now.since(view.state.stamp) <= MAX_STATE_AGE
            };
            let Some(view) = self.tick.arm_view(index).filter(fresh) else { continue };
            let commanded = view.command.mode.is_some_and(|mode| mode.is_position());
            let values = if commanded { view.command.values } else { view.state.position };
            let known = arm.joints.iter().cloned().zip(values).filter(|(_, value)| value.is_finite());
            positions.extend(known);
            let range = self.facts.gripper_info(index).and_then(|info| info.range);
            if let (Some(opening), Some((closed, open))) = (view.state.gripper, range)
                && open != closed
            {
                let part = ((opening - closed) / (open - closed)).clamp(0.0, 1.0);
                grippers.extend(arm.joints.iter().map(|joint| (joint.clone(), part)));
            }
        }
        Moment { plan, positions, grippers, paddings: self.paddings() }
    }
}

/// Returns the limits of each joint and of the speed of its arm's tool, as [`Service::begin`] checks them.
pub(in crate::runtime) fn command_limits(
    names: &Names,
    config: &CoordinatorConfig,
    arms: &[Arm],
) -> BTreeMap<String, CommandLimits> {
    let mut all = BTreeMap::new();
    for ((arm, named), described) in config.arms.iter().zip(&names.arms).zip(arms) {
        let l = &arm.limits;
        for (j, joint) in named.joints.iter().enumerate() {
            let of = |limits: &[f64]| limits.get(j).copied();
            let (Some(lower), Some(upper)) = (of(&l.position_lower), of(&l.position_upper)) else { continue };
            let (Some(velocity), Some(acceleration)) = (of(&l.velocity_max), of(&l.acceleration_max)) else { continue };
            let b = JointBounds::inside(lower, upper, velocity, acceleration);
            let jerk = of(&l.jerk_max).unwrap_or(DEFAULT_JERK);
            let limits = CommandLimits {
                position: [b.lower, b.upper],
                velocity,
                acceleration,
                jerk,
                tcp_velocity: described.tcp_velocity,
            };
            all.insert(joint.clone(), limits);
        }
    }
    all
}

/// Answers an encoded request of a run, in the process of an attached planner.
pub(in crate::runtime) async fn answer_encoded(
    port: &PlannerPort,
    asked: api::PlannerRequest,
) -> Result<Value, RpcError> {
    let encoded = |e: serde_json::Error| RpcError::new(Code::Internal, e.to_string());
    if asked.method == RECHECK {
        let call = serde_json::from_value(asked.params).map_err(encoded)?;
        return serde_json::to_value(port.recheck(&call, &asked.moment).await?).map_err(encoded);
    }
    match Call::read(&asked.method, asked.params)? {
        Call::ExecutePlan(execute) => {
            let released = port.release(&execute, &asked.moment).await?;
            serde_json::to_value(released).map_err(encoded)
        }
        call => serde_json::to_value(port.answer(call, &asked.moment).await?).map_err(encoded),
    }
}
