//! Runs the steps of a job, and decides what follows when one fails.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use super::names::Names;
use super::step::{Act, Job, Motion, Step};
use super::times::Times;
use crate::cli::banner;
use crate::cli::exit::{Exit, Failure};
use crate::cli::follow::{Signals, completed};
use crate::cli::going::{self, NotBegun};
use crate::cli::grip::{self, GripAction, Opening};
use crate::cli::output;
use dimos_rpc::Code;
use dimos_rpc::api::{
    ArmEnable, ArmIo, ArmIoSet, ArmReset, Detach, Go, GoStep, GripOutcome, Move, Plan, Status, World,
};
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::report::ArmReport;

/// Poll period of a wait.
const POLL_PERIOD: Duration = Duration::from_millis(50);
/// Causes of a hold by a person or another program, or by what somebody has put in the way: a job neither clears them
/// nor continues after them.
const BY_OTHERS: [&str; 10] = [
    "operator_stop",
    "stop_input",
    "stopped_elsewhere",
    "mode_changed",
    "power_changed",
    "power_lost",
    "identity_changed",
    "limits_changed",
    "way_blocked",
    "shutdown",
];

/// Why a job ends before its time.
pub enum End {
    /// A signal.
    Signal(i32),
    /// A person or another program stopped it, or the run has gone: nothing else is done.
    Stopped(Failure),
    /// A fault: `on_fault` follows.
    Fault(Failure),
}

impl From<Failure> for End {
    fn from(failure: Failure) -> Self {
        match failure.exit {
            Exit::Interrupted => Self::Signal(libc::SIGINT),
            Exit::Terminated => Self::Signal(libc::SIGTERM),
            _ => Self::Fault(failure),
        }
    }
}

impl From<ClientError> for End {
    fn from(error: ClientError) -> Self {
        match &error {
            ClientError::Refused(refusal) if !matches!(refusal.code, Code::LeaseHeld | Code::Superseded) => {
                Self::Fault(error.into())
            }
            _ => Self::Stopped(error.into()),
        }
    }
}

/// A job that is running.
pub struct Runner<'r, 'c> {
    /// The connection to the run.
    pub client: &'c mut Client,
    /// Ctrl-C.
    pub signals: &'r Signals,
    /// The job.
    pub job: &'r Job,
    /// What the run has.
    pub names: &'r Names,
    /// Durations of each step [s].
    pub times: Vec<Times>,
    /// Durations of whole cycles [s].
    pub cycles: Times,
    /// Whether nothing but errors is printed.
    pub quiet: bool,
    /// The arms that it commands.
    pub arms: BTreeSet<String>,
    /// Arms that were ready since the job began; `true`: since its last fault.
    pub ready: BTreeSet<(String, bool)>,
    /// The epoch of its requests: an arm that was interrupted since is not moved.
    pub epoch: u64,
}

type Outcome<T = (), E = End> = Result<T, E>;

impl<'r> Runner<'r, '_> {
    /// Runs all cycles. The error has the step at which the job ended.
    pub fn run(&mut self) -> Outcome<(), (&'r Step, End)> {
        if let Some(first) = self.job.steps.first() {
            self.begin_epoch().map_err(|end| (first, end))?;
        }
        while self.job.repeat.is_none_or(|cycles| self.cycles.count() < cycles) {
            let began = Instant::now();
            self.steps(&self.job.steps)?;
            let took = began.elapsed().as_secs_f64();
            self.cycles.add(took);
            if !self.quiet && self.job.repeat != Some(1) {
                let of = self.job.repeat.map_or_else(String::new, |cycles| format!(" of {cycles}"));
                output::note(format_args!("cycle {}{of}: {took:.2} s", self.cycles.count()));
            }
        }
        Ok(())
    }

    /// Runs the steps that follow a fault, if the arm can move or the first of them resets or enables it. Returns what
    /// became of them.
    pub fn on_fault(&mut self) -> Result<String, (String, Option<i32>)> {
        let steps = &self.job.on_fault;
        let Some(first) = steps.first() else { return Ok("none".into()) };
        let status = self.client.call(Status {}).map_err(|e| (format!("not run: {e}"), None))?;
        let held = status.arms.iter().find(|arm| arm.phase != "ready" && self.arms.contains(&arm.hardware_id));
        if let Some(arm) = held.filter(|_| !matches!(first.act, Act::Reset | Act::Enable)) {
            return Err((format!("not run: {}", not_ready(arm)), None));
        }
        self.ready.retain(|(_, now)| !now);
        self.begin_epoch_at(status.epoch);
        self.steps(steps).map(|()| "done".to_owned()).map_err(|(step, end)| match end {
            End::Signal(signal) => ("interrupted".to_owned(), Some(signal)),
            End::Stopped(failure) | End::Fault(failure) => (format!("failed at line {}: {failure}", step.line), None),
        })
    }

    fn seen(&self, arm: &str) -> bool {
        self.ready.contains(&(arm.to_owned(), false))
    }

    fn steps(&mut self, steps: &'r [Step]) -> Outcome<(), (&'r Step, End)> {
        for step in steps {
            let began = Instant::now();
            self.step(step).map_err(|(at, end)| (at, self.judged(end)))?;
            if let Some(times) = self.times.get_mut(step.id) {
                times.add(began.elapsed().as_secs_f64());
            }
        }
        Ok(())
    }

    /// Returns a fault as a stop if an arm is held because of a person or another program.
    fn judged(&mut self, end: End) -> End {
        let End::Fault(failure) = end else { return end };
        match self.client.call(Status {}) {
            Ok(status) if !status.arms.iter().any(|arm| self.arms.contains(&arm.hardware_id) && is_by_others(arm)) => {
                End::Fault(failure)
            }
            _ => End::Stopped(failure),
        }
    }

    fn step(&mut self, step: &'r Step) -> Outcome<(), (&'r Step, End)> {
        if let Act::Repeat { times, steps } = &step.act {
            return (0..*times).try_for_each(|_| self.steps(steps));
        }
        self.perform(step).map_err(|end| (step, end))
    }

    /// Performs a step. A payload that it sets may disable the arm for a moment: that is no interruption by others.
    fn perform(&mut self, step: &Step) -> Outcome {
        let sets_payload = matches!(step.act, Act::Attach(_) | Act::Detach(_));
        let undisturbed = sets_payload && self.client.call(Status {})?.epoch == self.epoch;
        self.act(step)?;
        if undisturbed { self.begin_epoch() } else { Ok(()) }
    }

    /// What has interrupted the arms is known: what does so from now on ends the job.
    fn begin_epoch(&mut self) -> Outcome {
        let epoch = self.client.call(Status {})?.epoch;
        self.begin_epoch_at(epoch);
        Ok(())
    }

    fn begin_epoch_at(&mut self, epoch: u64) {
        self.epoch = epoch;
        self.client.since(epoch);
    }

    fn act(&mut self, step: &Step) -> Outcome {
        self.signals.check()?;
        if !matches!(step.act, Act::Reset | Act::Enable) {
            self.look()?;
        }
        let arm = || step.arm.clone();
        match &step.act {
            Act::Move(motion) => self.motion(step, motion)?,
            Act::Gripper { to, force, object, timeout } => self.gripper(step, (*to, *force), *object, *timeout)?,
            Act::Wait(time) => self.wait(Some(*time), |_| Ok(false)).map(drop)?,
            Act::Input { input, high, timeout } => {
                let number = input.get(2..).and_then(|number| number.parse::<usize>().ok()).unwrap_or(0);
                let is_there = |client: &mut Client| -> Outcome<bool> {
                    let levels = client.call(ArmIo { arm: arm() })?.digital_inputs;
                    Ok(levels.get(number) == Some(high))
                };
                if !self.wait(*timeout, is_there)? {
                    let (is, wanted) = if *high { ("low", "high") } else { ("high", "low") };
                    let after = timeout.unwrap_or_default().as_secs_f64();
                    let what = format!("{input} of {} is {is} after {after} s, not {wanted}", step.arm);
                    return Err(Failure::new(Exit::Failed, what).into());
                }
            }
            Act::Output(outputs) => drop(self.client.call(ArmIoSet { arm: arm(), outputs: outputs.clone() })?),
            Act::Attach(attach) => drop(self.client.call(attach.clone())?),
            Act::Detach(name) => {
                let objects = self.client.call(World {})?.objects;
                if objects.iter().any(|object| object.name == *name && object.held_by.is_some()) {
                    self.client.call(Detach { name: name.clone() })?;
                }
            }
            Act::Reset => {
                let status = self.client.call(Status {})?;
                let by_others = |a: &&ArmReport| a.hardware_id == step.arm && is_by_others(a);
                if let Some(held) = status.arms.iter().find(by_others).filter(|arm| self.seen(&arm.hardware_id)) {
                    let what = format!("{}; a job does not clear that", not_ready(held));
                    return Err(End::Stopped(Failure::new(Exit::Failed, what)));
                }
                self.client.call(ArmReset { arm: arm() })?;
            }
            Act::Enable => drop(self.client.call(ArmEnable::new(arm()))?),
            Act::Repeat { .. } => {}
        }
        Ok(())
    }

    /// Fails if an arm that was ready no longer is.
    fn look(&mut self) -> Outcome {
        for arm in self.client.call(Status {})?.arms {
            let name = arm.hardware_id.clone();
            if arm.phase == "ready" {
                self.ready.extend([(name.clone(), false), (name, true)]);
            } else if self.ready.contains(&(name, true)) {
                return Err(Failure::new(Exit::Failed, not_ready(&arm)).into());
            }
        }
        Ok(())
    }

    /// Waits until `is_over`, at most `time`. Returns whether it was over before. Notices a stop.
    fn wait(&mut self, time: Option<Duration>, is_over: impl Fn(&mut Client) -> Outcome<bool>) -> Outcome<bool> {
        let began = Instant::now();
        loop {
            if is_over(self.client)? {
                return Ok(true);
            }
            let left = time.map_or(POLL_PERIOD, |time| time.saturating_sub(began.elapsed()));
            if left.is_zero() {
                return Ok(false);
            }
            std::thread::sleep(left.min(POLL_PERIOD));
            self.signals.check()?;
            self.look()?;
        }
    }

    fn motion(&mut self, step: &Step, motion: &Motion) -> Outcome {
        let Motion { goal, speed, .. } = motion;
        let title = format!("line {}: {}", step.line, step.text);
        let step = if motion.direct {
            let named = || goal.named.as_ref().and_then(|name| self.names.named(&step.arm, name));
            let target = goal.joints.clone().or_else(named).unwrap_or_default();
            GoStep::Move(Box::new(Move::direct(step.arm.clone(), target, *speed)))
        } else {
            let (goals, through) = (vec![goal.clone()], motion.through.clone());
            let Motion { blend, tcp_speed, .. } = *motion;
            let touch = motion.touch.clone();
            let plan = Plan { goals, speed: *speed, through, blend, tcp_speed, touch, ..Plan::default() };
            GoStep::Plan(Box::new(plan))
        };
        let (replan, on_path) = (motion.replan && !motion.direct, motion.on_path.clone());
        let until = motion.until.iter().cloned().collect();
        let go = Go { steps: vec![step], replan, on_path, until, ..Go::default() };
        let at = (self.client.call(go)?.going, 0);
        let begun = going::begin(self.client, at, Some(self.signals), false).map_err(|why| match why {
            // Another client's `cancel`, maybe at a waypoint.
            NotBegun::NoPlan(failure) if failure.what.ends_with("cancelled") => End::Stopped(failure),
            NotBegun::Refused(error) => error.into(),
            why => Failure::from(why).into(),
        })?;
        let (report, signal) = going::follow(self.client, at.0, &begun.reply, &title, self.signals)?;
        if let Some(signal) = signal {
            return Err(End::Signal(signal));
        }
        let result = completed(self.client, &report);
        // The words of the run for a `cancel`, its own end, and a task that took the arm.
        let by_others = report.error.as_deref().is_some_and(|why| {
            why == "cancelled" || ["task ", "the run ", "the log "].iter().any(|start| why.starts_with(start))
        });
        result.map_err(|failure| if by_others { End::Stopped(failure) } else { End::from(failure) })?;
        let Some(until) = &motion.until else { return Ok(()) };
        match going::outcome(self.client, at.0, report.motion)? {
            Some(outcome) if until.is_awaited(outcome.ended_by) => Ok(()),
            _ => {
                let how = report.error.as_deref().unwrap_or("the goal came first");
                let what = format!("the motion did not end as awaited: {how}");
                Err(Failure::new(Exit::Failed, what).into())
            }
        }
    }

    fn gripper(
        &mut self,
        step: &Step,
        (to, force): (Opening, Option<f64>),
        object: Option<bool>,
        timeout: Duration,
    ) -> Outcome {
        let arm = step.arm.clone();
        let action = GripAction { opening: to, force, speed: None, timeout: Some(timeout), objects: None };
        let order = action.send(self.client, &arm)?.order;
        let report = grip::wait(self.client, &arm, order, self.signals);
        let report = report.map_err(|failure| self.signals.last().map_or_else(|| failure.into(), End::Signal))?;
        let holds = report.outcome == Some(GripOutcome::Holding);
        let wrong = match (report.outcome, object) {
            (None, _) => {
                let why = report.error.as_deref().unwrap_or("no reason is known");
                let what = format!("the gripper of {arm} did not settle: {why}; {}", report.text());
                return Err(Failure::new(Exit::Failed, what).into());
            }
            (Some(GripOutcome::Blocked), _) => "did not get there",
            (Some(GripOutcome::Ordered), Some(_)) => "cannot tell whether it holds something",
            (Some(_), Some(true)) if !holds => "holds nothing",
            (Some(_), Some(false)) if holds => "holds something",
            _ => return Ok(()),
        };
        let what = format!("the gripper of {arm} {wrong}: {}", report.text());
        Err(Failure::new(Exit::Failed, what).into())
    }
}

fn is_by_others(arm: &ArmReport) -> bool {
    arm.phase != "ready" && arm.cause.as_ref().is_some_and(|cause| BY_OTHERS.contains(&cause.name.as_str()))
}

/// Describes an arm that cannot move.
fn not_ready(arm: &ArmReport) -> String {
    let cause = banner::cause(arm).map_or_else(String::new, |cause| format!(": {cause}"));
    format!("{} is {}{cause}", arm.hardware_id, arm.phase)
}
