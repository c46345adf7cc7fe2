//! The steps of a request `go`: checked before the first one begins, then carried out one after the other.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use super::going::{Going, POLL_PERIOD};
use super::on_path::Acts;
use super::until::awaiting;
use crate::runtime::{Service, internal};
use dimos_control::request::Request;
use dimos_core::telemetry::{Origin, TaskState};
use dimos_rpc::api::{
    EndedBy, ExecutePlan, GoBegun, GoPhase, GoStep, OnPath, Plan, PlanGoal, PlanSummary, Planning, Reply,
    Request as Call, RobotReport, Until,
};
use dimos_rpc::report::MotionReport;
use dimos_rpc::{Backend, Code, RpcError, Subject};

/// Time for a `cancel` to reach the motion itself.
const CANCEL_TIMEOUT: Duration = Duration::from_millis(100);
/// An act on a path is close [s], and then looked for this often: a part of the shortest tick.
const SOON: f64 = 0.1;
const ACT_PERIOD: Duration = Duration::from_micros(500);
/// Longest that an ending run is waited for to end a motion.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(3);

/// Why a request `go` ended with a step; without an error, a motion ended elsewhere than at its goal.
pub struct Failed {
    /// What ended it.
    pub by: EndedBy,
    /// Why.
    pub error: Option<RpcError>,
}

/// What a request asks of one of its steps.
pub struct Asked<'a> {
    /// As in the request.
    pub replan: bool,
    /// As in the request.
    pub unproven: bool,
    /// Acts on its path, with their indices in the request.
    pub acts: Vec<(usize, OnPath)>,
    /// What ends its motion before the goal.
    pub until: Option<&'a Until>,
}

impl Service {
    /// Checks what can be checked before anything moves; mistakes of the first step are found before it moves anyway.
    /// Returns the arms that are to move; a step that executes the newest plan gets its number.
    pub(in crate::runtime) async fn check_steps(&self, steps: &mut [GoStep]) -> Result<Vec<u16>, RpcError> {
        let plans = steps.iter().any(|step| matches!(step, GoStep::Plan(_)));
        let robots = if plans { self.robots().await? } else { Vec::new() };
        let mut arms = BTreeSet::new();
        for (index, step) in steps.iter_mut().enumerate() {
            match step {
                GoStep::Plan(plan) => {
                    let goals = || plan.goals.iter().chain(&plan.through);
                    if index > 0 {
                        self.check_names(&robots, goals()).await?;
                    }
                    let is_meant = |robot: &&RobotReport| goals().any(|goal| goal.robot == robot.name);
                    let moved: Vec<String> = robots.iter().filter(is_meant).flat_map(|r| r.joints.clone()).collect();
                    arms.extend(self.arms_with(&moved)?);
                }
                GoStep::ExecutePlan(execute) => {
                    let (plan, moved) = self.plan_and_its_joints(execute.plan).await?;
                    execute.plan = Some(plan);
                    arms.extend(self.arms_with(&moved)?);
                }
                GoStep::Execute(execute) => arms.extend(self.arms_with(&execute.trajectory.joint_names)?),
                GoStep::Move(direct) => {
                    arms.insert(self.facts.arm_index(&direct.arm)?);
                    if !direct.direct {
                        self.plans.needs_no_plan(&direct.arm)?;
                    }
                }
                GoStep::Gripper(gripper) => {
                    arms.insert(self.facts.arm_index(&gripper.arm)?);
                    if index > 0 {
                        self.check_grip(gripper).await?;
                    }
                }
            }
        }
        Ok(arms.into_iter().collect())
    }

    /// Returns the arms that have these joints.
    fn arms_with(&self, joints: &[String]) -> Result<Vec<u16>, RpcError> {
        let arms = self.facts.joints_named(joints)?.into_iter().filter_map(|joint| self.facts.locate(joint));
        Ok(arms.map(|(arm, _)| arm as u16).collect())
    }

    /// Fails if a goal is a named pose that neither its robot nor the user has.
    async fn check_names<'g>(
        &self,
        robots: &[RobotReport],
        goals: impl Iterator<Item = &'g PlanGoal> + Send,
    ) -> Result<(), RpcError> {
        let named: Vec<_> = goals.filter_map(|goal| Some((&goal.robot, goal.named.as_ref()?))).collect();
        if named.is_empty() {
            return Ok(());
        }
        let saved = self.poses().await?.poses;
        for (robot, name) in named {
            let poses = robots.iter().filter(|known| known.name == *robot).flat_map(|robot| robot.named_poses.keys());
            let known: Vec<&String> = poses.chain(saved.keys()).collect();
            if !known.contains(&name) {
                return Err(RpcError::unknown(Code::InvalidParams, "pose", name, &known));
            }
        }
        Ok(())
    }

    /// Carries out a step, and returns what has ended it.
    pub(in crate::runtime) async fn carry_out_step(
        &self,
        going: &Going,
        step: GoStep,
        asked: Asked<'_>,
        origin: &mut Origin,
    ) -> Result<EndedBy, Failed> {
        let Asked { replan, unproven, acts, until } = asked;
        let mut none = Acts::default();
        let ended = match step {
            GoStep::Plan(plan) => {
                for (_, act) in &acts {
                    if let Some(gripper) = &act.gripper {
                        self.check_grip(gripper).await?;
                    }
                }
                let (plan, summary) = self.plan_step(going, *plan, *origin).await?;
                let mut acts = self.acts_of(acts, plan, &summary).await?;
                let execute = ExecutePlan { plan: Some(plan), replan, unproven, ..ExecutePlan::default() };
                let done = self.execute_step(going, execute, &summary.joints, (&mut acts, until), *origin).await;
                self.restore_speed(&mut acts, *origin).await;
                done
            }
            GoStep::ExecutePlan(execute) => {
                let (_, joints) = self.plan_and_its_joints(execute.plan).await?;
                self.execute_step(going, *execute, &joints, (&mut none, until), *origin).await
            }
            GoStep::Move(direct) => {
                let arms = [direct.arm.clone()];
                let judged = self.judged(until, going, None).await?;
                let call = awaiting(judged, self.move_step(going, &arms, Call::Move(*direct), &mut none, *origin));
                call.await
            }
            GoStep::Execute(execute) => {
                let arms = self.arms_of(Subject::Joints(&execute.trajectory.joint_names));
                let judged = self.judged(until, going, None).await?;
                let call = awaiting(judged, self.move_step(going, &arms, Call::Execute(*execute), &mut none, *origin));
                call.await
            }
            GoStep::Gripper(gripper) => self.grip_step(going, *gripper, origin).await.map(|()| EndedBy::Goal),
        }?;
        self.ended_as_awaited(until, ended)
    }

    /// Returns the conditions of a step as the tick judges them.
    async fn judged(
        &self,
        until: Option<&Until>,
        going: &Going,
        plan: Option<u64>,
    ) -> Result<Option<dimos_core::until::Until>, Failed> {
        let Some(until) = until else { return Ok(None) };
        let covered = match plan.filter(|_| until.distance.is_some() || until.stiffness.is_some()) {
            Some(plan) => Some(self.covered_by(plan).await?),
            None => None,
        };
        let judged = self.until_of(until, going.arms(), covered.as_ref())?;
        if let Some(peak) = covered.and_then(|covered| self.peak(until, judged.arm, &covered)) {
            going.step(GoPhase::Planning, |step| step.peak = Some(peak));
        }
        Ok(Some(judged))
    }

    /// Makes a plan. Returns its number and its figures.
    async fn plan_step(&self, going: &Going, plan: Plan, origin: Origin) -> Result<(u64, PlanSummary), Failed> {
        going.check()?;
        // It is this request's own: `execute_plan` without a number passes it over.
        let request = Call::Plan(Plan { by_number: true, ..plan });
        let begun = Box::pin(self.answer_counted(request, origin)).await?;
        let Reply::Plan(begun) = begun else { return Err(internal().into()) };
        let mut ends = false;
        loop {
            let asked = Call::Planning(Planning { plan: begun.plan });
            let Reply::Planning(report) = self.planner_call(asked).await? else { return Err(internal().into()) };
            going.step(GoPhase::Planning, |step| step.planning = Some(report.clone()));
            if report.state != "PLANNING" {
                if let Some(summary) = report.summary {
                    return Ok((begun.plan, summary));
                }
                return Err(going.check().err().filter(|_| going.is_client_gone()).unwrap_or_else(|| report.into()));
            }
            let is_over = going.check().is_err() || self.lifecycle.is_closed();
            if is_over && !std::mem::replace(&mut ends, true) {
                self.cancel_planning(Some(begun.plan)).await;
            }
            tokio::time::sleep(POLL_PERIOD).await;
        }
    }

    async fn execute_step(
        &self,
        going: &Going,
        execute: ExecutePlan,
        joints: &[String],
        (acts, until): (&mut Acts, Option<&Until>),
        origin: Origin,
    ) -> Result<EndedBy, Failed> {
        let arms = self.arms_of(Subject::Joints(joints));
        let judged = self.judged(until, going, execute.plan).await?;
        let execute = ExecutePlan { presence: going.presence(), ..execute };
        awaiting(judged, self.move_step(going, &arms, Call::ExecutePlan(execute), acts, origin)).await
    }

    /// Begins a motion and waits for its end, and for that of those that continue it around an obstacle. Returns what
    /// has ended it.
    async fn move_step(
        &self,
        going: &Going,
        arms: &[String],
        call: Call,
        acts: &mut Acts,
        origin: Origin,
    ) -> Result<EndedBy, Failed> {
        let (method, answer) = (call.method(), Box::pin(self.answer_counted(call, origin)));
        let begun = match going.command(arms, method, answer).await? {
            Reply::Move(reply) => GoBegun::Move(reply),
            Reply::Execute(reply) | Reply::ExecutePlan(reply) => GoBegun::Execute(reply),
            _ => return Err(internal().into()),
        };
        let mut motion = begun.motion();
        let (mut begun, mut ended, mut closed, mut lost) = (Some(begun), None, None, None::<Failed>);
        loop {
            let mut report = self.motion(motion)?;
            if !report.done && lost.is_none() {
                lost = self.lost_grip(going);
                if lost.is_some() {
                    self.ask(Request::Cancel { task: Some(self.facts.task_index(&report.task)?) }).await?;
                }
            }
            if let Some(failed) = lost.as_ref().filter(|_| report.done) {
                report.error = failed.error.as_ref().map(|error| error.message.clone());
            }
            let phase = if report.replanning { GoPhase::Replanning } else { GoPhase::Executing };
            going.step(phase, |step| {
                step.begun = begun.take().or(step.begun.take());
                match step.motions.last_mut().filter(|last| last.motion == motion) {
                    Some(last) => last.clone_from(&report),
                    None => step.motions.push(report.clone()),
                }
            });
            let wait = self.act_on_path(going, &report, acts, origin).await?;
            match report.next.filter(|_| report.done) {
                Some(next) => {
                    motion = next;
                    continue;
                }
                None if !report.done => {}
                None if report.state == TaskState::Completed.name() => return Ok(self.cause_of_end(motion).0),
                None if lost.is_some() => {
                    let by = self.cause_of_end(motion).0;
                    return lost.map_or(Ok(by), Err);
                }
                None => return Err(Failed { by: self.cause_of_end(motion).0, error: None }),
            }
            // The `cancel` that ended this was of another arm of it, or came before the motion was known.
            let is_ended = going.curb.ended().is_some() && report.state == TaskState::Executing.name();
            if is_ended && ended.get_or_insert_with(Instant::now).elapsed() > CANCEL_TIMEOUT {
                self.ask(Request::Cancel { task: Some(self.facts.task_index(&report.task)?) }).await?;
                ended = Some(Instant::now());
            }
            if self.lifecycle.is_closed() && closed.get_or_insert_with(Instant::now).elapsed() > SHUTDOWN_TIMEOUT {
                return Err(RpcError::new(Code::ShuttingDown, "the run ends").into());
            }
            tokio::time::sleep(wait).await;
        }
    }

    /// Does the acts on the path of a motion that are due; one that is refused ends the motion. Returns when to look
    /// again.
    async fn act_on_path(
        &self,
        going: &Going,
        report: &MotionReport,
        acts: &mut Acts,
        origin: Origin,
    ) -> Result<Duration, Failed> {
        let task = self.facts.task_index(&report.task)?;
        let view = self.tick.task_view(task.into());
        let completed = report.state == TaskState::Completed.name();
        // Before its first tick, and after its end, the task has another motion's figures.
        if !completed && (report.done || view.motion != report.motion) {
            return Ok(POLL_PERIOD);
        }
        if let Err(failed) = self.do_acts(going, acts, (&view, completed), origin).await {
            self.ask(Request::Cancel { task: Some(task) }).await?;
            return Err(failed);
        }
        let soon = acts.until(&view, self.tick.speed_override().fraction).is_some_and(|left| left < SOON);
        Ok(if soon { ACT_PERIOD } else { POLL_PERIOD })
    }
}
