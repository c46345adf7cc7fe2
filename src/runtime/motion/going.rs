//! Motions as a whole: a request `go` is carried out step by step, on its own thread, until its goal, a failure, a stop
//! or a `cancel`. Each step is answered as if its client had requested it: same origin, same leases, same log.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use super::go_steps::{Asked, Failed};
use crate::runtime::client::asker::{asked_by, asker};
use crate::runtime::client::curb::{Curb, curbed};
use crate::runtime::{Service, internal};
use dimos_control::request::Request;
use dimos_core::sync::lock;
use dimos_core::telemetry::{Cause, Origin, Phase, Reason, Who};
use dimos_rpc::api::{
    self, CancelReply, EndedBy, Go, GoOutcome, GoPhase, GoReply, GoStep, GoStepReport, GoingReport, OnPath, Presence,
    Reply,
};
use dimos_rpc::{Claimant, Code, RpcError};

/// Poll period while waiting for planners, arms and fingers.
pub(in crate::runtime) const POLL_PERIOD: Duration = Duration::from_millis(5);
/// Maximum number of requests kept.
const REMEMBERED: usize = 64;
/// Maximum wait for one of the same arm whose motion has just ended.
const OVERLAP: Duration = Duration::from_millis(200);

/// A request `go`.
pub struct Going {
    number: u64,
    /// The arms that it may move.
    arms: Vec<u16>,
    claimant: Option<Claimant>,
    /// Ended by a `cancel`, and by a stop of an arm that it has moved.
    pub curb: Arc<Curb>,
    by: Option<Arc<Who>>,
    report: Mutex<GoingReport>,
    /// The arms whose grippers it still needs.
    grips: Mutex<Vec<u16>>,
}

/// The latest requests `go`, by number.
#[derive(Default)]
pub struct Goings(Mutex<BTreeMap<u64, Arc<Going>>>);

impl Going {
    /// Changes what is reported.
    pub fn update(&self, change: impl FnOnce(&mut GoingReport)) {
        change(&mut lock(&self.report));
    }

    /// Changes what is reported of the present step, in this phase.
    pub fn step(&self, phase: GoPhase, change: impl FnOnce(&mut GoStepReport)) {
        self.update(|report| {
            report.phase = phase;
            report.steps.last_mut().map(change);
        });
    }

    /// Returns whether the connection that requested it has ended: a motion that has begun continues, nothing else
    /// begins.
    pub fn is_client_gone(&self) -> bool {
        self.claimant.as_ref().is_some_and(|claimant| claimant.presence().is_over())
    }

    /// Returns the arms that it may move.
    pub fn arms(&self) -> &[u16] {
        &self.arms
    }

    /// Returns the presence of that connection.
    pub fn presence(&self) -> Option<Presence> {
        Some(self.claimant.as_ref()?.presence().clone())
    }

    /// Fails if nothing else of it may begin.
    pub fn check(&self) -> Result<(), Failed> {
        let ended = |by, why: &str| {
            let error = RpcError::new(Code::Superseded, format!("it ended before its next motion: {why}"));
            Err(Failed { by, error: Some(error.hint("request it again if it is still wanted")) })
        };
        match self.curb.ended() {
            Some(why) => ended(if why == CANCELLED { EndedBy::Cancelled } else { EndedBy::Stop }, &why),
            None if self.is_client_gone() => ended(EndedBy::ClientGone, "its client has disconnected"),
            None => Ok(()),
        }
    }

    /// Answers a request of a step, for this method, under the leases of these arms.
    pub async fn command(
        &self,
        arms: &[String],
        method: &'static str,
        answer: impl Future<Output = Result<Reply, RpcError>>,
    ) -> Result<Reply, Failed> {
        self.check()?;
        let reply = match &self.claimant {
            Some(claimant) => claimant.command(arms, method, answer).await,
            None => answer.await,
        };
        // What ended it is the reason, not that its request was not sent.
        reply.map_err(|error| self.check().err().unwrap_or_else(|| error.into()))
    }

    /// Returns the plan that is being made, and the task that executes a motion.
    fn under_way(&self) -> (Option<u64>, Option<String>) {
        let report = lock(&self.report);
        let Some(step) = report.steps.last().filter(|_| !report.done) else { return (None, None) };
        let planning = step.planning.as_ref().filter(|planning| planning.state == "PLANNING");
        let moves = step.motions.last().is_some_and(|motion| !motion.done);
        let task = step.begun.as_ref().filter(|_| moves).map(|begun| begun.task().to_owned());
        (planning.map(|planning| planning.plan), task)
    }

    fn is_done(&self) -> bool {
        lock(&self.report).done
    }
}

/// The words for a `cancel`.
pub(in crate::runtime) const CANCELLED: &str = "cancelled";

impl Service {
    /// Begins to carry out a request `go`.
    pub(in crate::runtime) async fn go(&self, mut go: Go, origin: Origin) -> Result<GoReply, RpcError> {
        let arms = self.check_steps(&mut go.steps).await?;
        self.check_until(&go.until, &arms).await?;
        let number = self.tick.dispatcher().next_id();
        let by = asker();
        let report = GoingReport { going: number, by: by.as_deref().cloned(), ..GoingReport::default() };
        let (claimant, curb, grips) = (go.claimant.take(), Arc::default(), Mutex::default());
        let going = Going { number, arms, claimant, curb, by, report: report.into(), grips };
        let going = Arc::new(going);
        self.keep_going(&going).await?;
        let started = self.start_going(going.clone(), go, origin);
        if let Err(error) = &started {
            finish(&going, Failed::from(error.clone()), GoOutcome::default());
        }
        started.map(|()| GoReply { going: number })
    }

    /// Keeps a request, if no other one moves its arms.
    async fn keep_going(&self, going: &Arc<Going>) -> Result<(), RpcError> {
        let began = Instant::now();
        loop {
            let other = {
                let mut goings = lock(&self.goings.0);
                let is_other = |other: &&Arc<Going>| {
                    !other.is_done() && !other.is_client_gone() && other.arms.iter().any(|arm| going.arms.contains(arm))
                };
                let Some(other) = goings.values().find(is_other).map(|other| other.number) else {
                    while goings.len() >= REMEMBERED {
                        goings.pop_first();
                    }
                    goings.insert(going.number, going.clone());
                    return Ok(());
                };
                other
            };
            // Its client may have seen the end of its motion before this program has.
            if began.elapsed() > OVERLAP {
                let what = format!("the arm is moved by an earlier request (go {other})");
                let error = RpcError::new(Code::AlreadyExecuting, what);
                return Err(error.hint("wait for it, or end it with `dimos cancel`"));
            }
            tokio::time::sleep(POLL_PERIOD).await;
        }
    }

    fn start_going(&self, going: Arc<Going>, go: Go, origin: Origin) -> Result<(), RpcError> {
        let me = self.me.upgrade().ok_or_else(internal)?;
        let failed = |e: std::io::Error| RpcError::new(Code::Internal, e.to_string());
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().map_err(failed)?;
        let work = move || {
            let work = curbed(going.curb.clone(), me.carry_out(&going, go, origin));
            match going.by.clone() {
                Some(who) => runtime.block_on(asked_by(who, work)),
                None => runtime.block_on(work),
            }
        };
        std::thread::Builder::new().name("going".into()).spawn(work).map(drop).map_err(failed)
    }

    async fn carry_out(&self, going: &Going, go: Go, mut origin: Origin) {
        let Go { steps, replan, unproven, on_path, until, .. } = go;
        let mut ended = Failed { by: EndedBy::Goal, error: None };
        for (index, step) in steps.iter().cloned().enumerate() {
            *lock(&going.grips) = self.grips_from(&steps, &on_path, index);
            let acts = on_path.iter().enumerate().filter(|(_, act)| act.step == index);
            let acts = acts.map(|(number, act)| (number, act.clone())).collect();
            going.update(|report| report.steps.push(GoStepReport::default()));
            going.step(GoPhase::Planning, |_| {});
            let until = until.iter().find(|until| until.step == index);
            let asked = Asked { replan, unproven, acts, until };
            match self.carry_out_step(going, step, asked, &mut origin).await {
                Ok(by) => ended.by = by,
                Err(failed) => {
                    ended = failed;
                    break;
                }
            }
        }
        // A refusal after a stop has that cause.
        let stopped = |arm: &u16| {
            self.tick.arm_view(usize::from(*arm)).is_some_and(|view| view.phase == Phase::Held && is_stop(view.cause))
        };
        if ended.by == EndedBy::Refused && going.arms.iter().any(stopped) {
            ended.by = EndedBy::Stop;
        }
        let motion = lock(&going.report).steps.iter().rev().find_map(|step| step.motions.last().cloned());
        let value = motion.as_ref().and_then(|motion| self.cause_of_end(motion.motion).1);
        let pose = match &going.arms[..] {
            [arm] => self.tcp_poses().get_mut(usize::from(*arm)).and_then(Option::take),
            _ => None,
        };
        let outcome = GoOutcome { motion, ended_by: ended.by, value, pose };
        finish(going, ended, outcome);
    }

    /// Returns the arms whose grippers are needed from a step on.
    fn grips_from(&self, steps: &[GoStep], on_path: &[OnPath], index: usize) -> Vec<u16> {
        let of_step = |step: &GoStep| if let GoStep::Gripper(grip) = step { Some(grip.arm.clone()) } else { None };
        let later = on_path.iter().filter(|act| act.step >= index);
        let acts = later.filter_map(|act| Some(act.gripper.as_ref()?.arm.clone()));
        let arms = steps.iter().skip(index).filter_map(of_step).chain(acts);
        arms.filter_map(|arm| self.facts.arm_index(&arm).ok()).collect()
    }

    /// Returns why what is still to be done cannot be: a gripper that it needs is lost.
    pub(in crate::runtime) fn lost_grip(&self, going: &Going) -> Option<Failed> {
        let lost = lock(&going.grips).iter().find_map(|arm| self.gripper_is_lost((*arm).into()))?;
        Some(Failed { by: EndedBy::Grip, error: Some(lost) })
    }

    /// Returns what ended a motion, and what was measured of that.
    pub(in crate::runtime) fn cause_of_end(&self, motion: u64) -> (EndedBy, Option<f64>) {
        let reason = match self.motions.get(motion) {
            Some((_, Some(end))) => end.reason,
            Some((planned, None)) => self.tick.task_view(planned.task.into()).reason,
            None => return (EndedBy::Other, None),
        };
        match reason {
            Reason::None => (EndedBy::Goal, None),
            Reason::Until(condition, value) => (condition.into(), Some(value)),
            Reason::Cancelled | Reason::StreamEnded => (EndedBy::Cancelled, None),
            Reason::Preempted(..) => (EndedBy::Replaced, None),
            Reason::WayBlocked | Reason::Guarded(_) | Reason::ArmHeld(_, Cause::WayBlocked) => (EndedBy::Blocked, None),
            Reason::Gap(_, distance, _) | Reason::ArmHeld(_, Cause::Gap(_, distance, _)) => {
                (EndedBy::Gap, Some(distance))
            }
            Reason::ArmHeld(_, cause) if is_stop(cause) => (EndedBy::Stop, None),
            _ => (EndedBy::Fault, None),
        }
    }

    /// Returns the progress or outcome of a request `go`.
    pub(in crate::runtime) fn going(&self, number: u64) -> Result<GoingReport, RpcError> {
        Ok(lock(&self.find_going(number)?.report).clone())
    }

    fn find_going(&self, number: u64) -> Result<Arc<Going>, RpcError> {
        let unknown = || RpcError::new(Code::UnknownMotion, format!("no request go {number}, or too long ago"));
        lock(&self.goings.0).get(&number).cloned().ok_or_else(unknown)
    }

    /// Ends the requests `go` that a `cancel` of this arm or task means; `None`: of any. Their motions end when the
    /// tick gets the `cancel`, or when their threads see this.
    pub(in crate::runtime) fn end_goings(&self, arm: Option<u16>, task: Option<u16>) {
        let (tasks, goings) = (&self.facts.config.tasks, lock(&self.goings.0));
        for going in goings.values().filter(|going| !going.is_done()) {
            let is_meant = match task.and_then(|task| tasks.get(usize::from(task))) {
                Some(task) => match going.under_way() {
                    (_, Some(moving)) => moving == task.name,
                    _ => {
                        let mut arms = task.joints.iter().filter_map(|joint| self.facts.locate(*joint));
                        arms.any(|(arm, _)| going.arms.iter().any(|own| usize::from(*own) == arm))
                    }
                },
                None => arm.is_none_or(|arm| going.arms.contains(&arm)),
            };
            if is_meant {
                going.curb.end(CANCELLED);
            }
        }
    }

    /// Ends a request `go`, and what is being done for it.
    pub(in crate::runtime) async fn cancel_going(&self, number: u64) -> Result<CancelReply, RpcError> {
        let going = self.find_going(number)?;
        if going.is_done() {
            return Ok(CancelReply::default());
        }
        going.curb.end(CANCELLED);
        match going.under_way() {
            (_, Some(task)) => {
                let index = self.facts.task_index(&task)?;
                self.motions.end_replanning(CANCELLED, |planned| planned.task == index);
                let outcome = self.ask(Request::Cancel { task: Some(index) }).await?;
                Ok(CancelReply { tasks: [(task, outcome.name().to_owned())].into(), ..CancelReply::default() })
            }
            (Some(plan), None) => {
                let planning = self.cancel_planning(Some(plan)).await;
                Ok(CancelReply { planning, ..CancelReply::default() })
            }
            _ => Ok(CancelReply::default()),
        }
    }
}

fn finish(going: &Going, ended: Failed, outcome: GoOutcome) {
    going.update(|report| {
        (report.phase, report.done, report.error) = (GoPhase::Ended, true, ended.error);
        report.outcome = Some(GoOutcome { ended_by: ended.by, ..outcome });
    });
}

/// Returns whether a person or another program has stopped the arm.
fn is_stop(cause: Cause) -> bool {
    matches!(cause, Cause::Operator | Cause::StopInput | Cause::StoppedElsewhere)
}

impl From<RpcError> for Failed {
    fn from(error: RpcError) -> Self {
        Self { by: EndedBy::Refused, error: Some(error) }
    }
}

impl From<api::PlanningReport> for Failed {
    fn from(report: api::PlanningReport) -> Self {
        let by = if report.state == "CANCELLED" { EndedBy::Cancelled } else { EndedBy::NoPlan };
        let error = RpcError::new(Code::NoPlan, report.error.unwrap_or_else(|| report.state.to_lowercase()));
        Self { by, error: Some(RpcError { hint: report.hint, ..error }) }
    }
}
