//! The coordinator: `tick` turns the arms' states and the requests of the moment into one command per arm. It
//! sleeps never, does no I/O, takes no lock, allocates and frees nothing; the same states, requests and times give
//! the same commands, bit for bit. A tick and what it keeps belong together, hence the length.

use std::time::Duration;

use super::arbitrate::Arbiter;
use super::arm_control::{ArmControl, Ask, Routed};
use super::config::CoordinatorConfig;
use super::limit::Refusal;
use super::request::{Envelope, Motion, Request};
use super::stalls::Stalls;
use super::task::Task;
use super::task_body::{JointView, Target};
use crate::arm::{ArmCommand, ArmState};
use crate::clock::Mono;
use crate::telemetry::{ArmSample, Cause, Event, Outcome, Phase, Reason, TaskState, TaskView};

/// At most this many requests are handled in one tick: as many as can wait, so that a stop is never kept waiting
/// by a flood of targets.
const REQUESTS_PER_TICK: usize = 256;
/// A tick this long after the one before makes all arms hold [s].
const LOST_TIME: f64 = 0.1;
/// Consecutive overruns that are reported as degraded.
const DEGRADED_AFTER: u32 = 10;

/// The times of a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TickTime {
    /// The tick's deadline: what it takes for "now".
    pub now: Mono,
    /// When the next one is due.
    pub next: Mono,
    /// Whole periods skipped before it.
    pub skipped: u32,
    /// The lateness that cost them [ns].
    pub late_ns: u64,
    /// Wake-up of this tick after the deadline that it was waiting for [ns].
    pub woke_late_ns: u64,
}

/// What a tick leaves behind. Reused from tick to tick.
#[derive(Debug)]
pub struct TickOutput {
    /// One command per arm.
    pub commands: Vec<ArmCommand>,
    /// One sample per arm.
    pub arms: Vec<ArmSample>,
    /// One view per task.
    pub tasks: Vec<TaskView>,
    /// What happened.
    pub events: Vec<Event>,
    /// Motions that are done, to be freed elsewhere.
    pub retired: Vec<Box<Motion>>,
    /// Events that found no room.
    pub events_lost: u32,
}

impl TickOutput {
    fn tell(&mut self, event: Event) {
        // As many as there was room for at the start: the tick allocates nothing.
        if self.events.len() < self.events.capacity() {
            self.events.push(event);
        } else {
            self.events_lost = self.events_lost.saturating_add(1);
        }
    }
}

/// The coordinator of all arms of a run.
#[derive(Debug)]
pub struct Coordinator {
    period: f64,
    /// The same [ns].
    period_ns: u64,
    arms: Vec<ArmControl>,
    tasks: Vec<Task>,
    arbiter: Arbiter,
    /// The arm of each joint.
    arm_of: Vec<u16>,
    joints: Vec<JointView>,
    overruns_in_a_row: u32,
    stalls: Stalls,
    shutting_down: bool,
    started: bool,
    output: TickOutput,
}

impl Coordinator {
    /// A coordinator of which no tick was run yet, with the configuration's tasks as
    /// [`TaskTable::build`](super::task_spec::TaskTable::build) made them. All memory it will need is taken here.
    pub fn new(config: &CoordinatorConfig, tasks: Vec<Task>) -> Self {
        let mut arm_of = Vec::new();
        let arms: Vec<ArmControl> = (config.arms.iter().enumerate())
            .map(|(i, arm)| {
                let first = arm_of.len();
                arm_of.extend(std::iter::repeat_n(i as u16, arm.dof));
                ArmControl::new(arm.clone(), first, config.period())
            })
            .collect();
        let priorities: Vec<i32> = tasks.iter().map(|t| t.priority).collect();
        // Each request has its outcome and may change a task; the rest reports a few times at most.
        let events = 2 * REQUESTS_PER_TICK + 4 * (arms.len() + tasks.len()) + arm_of.len();
        Self {
            period: 1.0 / config.rate,
            period_ns: Duration::from_secs_f64(1.0 / config.rate).as_nanos().max(1) as u64,
            arbiter: Arbiter::new(&priorities, arm_of.clone(), arms.len()),
            joints: vec![JointView::default(); arm_of.len()],
            output: TickOutput {
                commands: vec![ArmCommand::default(); arms.len()],
                arms: Vec::with_capacity(arms.len()),
                tasks: vec![TaskView::default(); tasks.len()],
                events: Vec::with_capacity(events),
                retired: Vec::with_capacity(2 * tasks.len() + REQUESTS_PER_TICK),
                events_lost: 0,
            },
            arms,
            tasks,
            arm_of,
            overruns_in_a_row: 0,
            stalls: Stalls::default(),
            shutting_down: false,
            started: false,
        }
    }

    /// The tasks, as the last tick left them.
    pub fn tasks(&self) -> &[Task] {
        &self.tasks
    }

    /// Whether no arm is being moved by commands.
    pub fn at_rest(&self) -> bool {
        self.arms.iter().all(ArmControl::at_rest) && !self.tasks.iter().any(Task::is_active)
    }

    /// One tick: `states` has the latest of each arm, `inbox` gives one waiting request after the other.
    pub fn tick(
        &mut self,
        time: TickTime,
        states: &[ArmState],
        mut inbox: impl FnMut() -> Option<Envelope>,
    ) -> &mut TickOutput {
        self.output.arms.clear();
        self.output.events.clear();
        // The caller has freed them elsewhere; only what it could not take is left.
        self.output.retired.clear();
        let late = Duration::from_nanos(time.woke_late_ns);
        self.stalls.note(time.now.after(Duration::from_nanos(time.woke_late_ns % self.period_ns)), late);
        self.read(time, states);
        self.account_for_lost_time(time);
        for _ in 0..REQUESTS_PER_TICK {
            let Some(envelope) = inbox() else { break };
            self.handle(time.now, envelope);
        }
        self.start_by_themselves(time.now);
        self.compute(time.now);
        let output = &mut self.output;
        let mut retired = std::mem::take(&mut output.retired);
        self.arbiter.decide(&mut self.tasks, |event| output.tell(event), |motion| retired.push(motion));
        output.retired = retired;
        self.route(time);
        self.publish();
        &mut self.output
    }

    fn read(&mut self, time: TickTime, states: &[ArmState]) {
        for (i, arm) in self.arms.iter_mut().enumerate() {
            let Some(state) = states.get(i) else { continue };
            if arm.read(state, time.now, &self.stalls, self.period) {
                let (phase, cause) = (arm.failsafe.phase(), arm.failsafe.cause());
                self.output.tell(Event::Arm(i as u16, phase, cause));
            }
            let views = self.joints.iter_mut().skip(arm.first()).zip(arm.limiters());
            for (j, (view, limiter)) in views.enumerate() {
                *view = JointView {
                    position: arm.state.position.get(j).copied().unwrap_or_default(),
                    velocity: arm.state.velocity.get(j).copied().unwrap_or_default(),
                    commanded: limiter.position(),
                    commanded_velocity: limiter.velocity(),
                    lower: limiter.bounds().lower,
                    upper: limiter.bounds().upper,
                    acceleration: limiter.bounds().acceleration,
                    velocity_limit: limiter.bounds().velocity,
                    jerk: arm.config().limits.jerk_max.get(j).copied().unwrap_or(crate::joint::DEFAULT_JERK),
                    tracking_error: arm.tracking_error(j),
                };
            }
        }
        self.end_tasks_of_held_arms();
    }

    fn account_for_lost_time(&mut self, time: TickTime) {
        if time.skipped == 0 {
            self.overruns_in_a_row = 0;
            return;
        }
        self.output.tell(Event::Overrun(time.skipped, time.late_ns));
        self.overruns_in_a_row += 1;
        if self.overruns_in_a_row == DEGRADED_AFTER {
            self.output.tell(Event::Degraded);
        }
        let since_last = time.late_ns as f64 * 1e-9 + self.period;
        if since_last >= LOST_TIME.max(3.0 * self.period) {
            for i in 0..self.arms.len() {
                self.hold(i, Cause::Overrun, time.now);
            }
        }
    }

    /// Latches an arm's hold and ends what its tasks do.
    fn hold(&mut self, arm: usize, cause: Cause, now: Mono) {
        if let Some(a) = self.arms.get_mut(arm) {
            let before = (a.failsafe.phase(), a.failsafe.cause());
            a.failsafe.hold(cause, now);
            if before != (a.failsafe.phase(), a.failsafe.cause()) {
                self.output.tell(Event::Arm(arm as u16, a.failsafe.phase(), a.failsafe.cause()));
            }
        }
        self.end_tasks_of_held_arms();
    }

    fn end_tasks_of_held_arms(&mut self) {
        for t in 0..self.tasks.len() {
            let Some(task) = self.tasks.get(t).filter(|t| t.is_active()) else { continue };
            let held = task.joints.iter().find_map(|&joint| {
                let arm = self.arm_of.get(joint as usize).copied()?;
                let failsafe = &self.arms.get(arm as usize)?.failsafe;
                (failsafe.phase() != Phase::Ready).then_some((arm, failsafe.cause()))
            });
            if let Some((arm, cause)) = held {
                self.end_task(t, TaskState::Aborted, Reason::ArmHeld(arm, cause));
            }
        }
    }

    fn end_task(&mut self, task: usize, state: TaskState, reason: Reason) {
        if let Some(t) = self.tasks.get_mut(task) {
            let motion = t.end(state, reason);
            self.output.retired.extend(motion);
            self.output.tell(Event::Task(task as u16, state, reason));
        }
    }

    fn handle(&mut self, now: Mono, envelope: Envelope) {
        let outcome = match envelope.request {
            Request::Shutdown => {
                self.shutting_down = true;
                self.cancel(None)
            }
            Request::Stop { arm } => self.stop(arm, now),
            Request::Cancel { task } => self.cancel(task),
            Request::Execute { motion, .. } if self.shutting_down => {
                self.output.retired.push(motion);
                Outcome::ShuttingDown
            }
            _ if self.shutting_down => Outcome::ShuttingDown,
            Request::Execute { task, motion } => self.execute(now, task, motion),
            Request::Servo { task, target } => self.offer(now, task, &Target::Positions(target)),
            Request::Velocity { task, target } => self.offer(now, task, &Target::Velocities(target)),
            Request::Steer { task, goal } => self.offer(now, task, &Target::EndEffector(goal)),
            Request::Reset { arm } => self.with_arm(arm, |a| a.failsafe.reset(arm, &a.state, a.freshness(), now)),
            Request::Ready { arm } => self.ready(arm, now),
            Request::Park { arm } => {
                let outcome = self.with_arm(arm, |a| {
                    a.failsafe.park(now);
                    Outcome::Accepted
                });
                self.end_tasks_of_held_arms();
                outcome
            }
            Request::Gripper { arm, opening } => self.gripper(arm, opening),
        };
        self.output.tell(Event::Request(envelope.id, outcome));
    }

    /// Acts on an arm and reports a change of its phase.
    fn with_arm(&mut self, arm: u16, act: impl FnOnce(&mut ArmControl) -> Outcome) -> Outcome {
        let Some(a) = self.arms.get_mut(arm as usize) else { return Outcome::StartStateUnavailable(arm) };
        let before = a.failsafe.phase();
        let outcome = act(a);
        if a.failsafe.phase() != before {
            self.output.tell(Event::Arm(arm, a.failsafe.phase(), a.failsafe.cause()));
        }
        outcome
    }

    fn ready(&mut self, arm: u16, now: Mono) -> Outcome {
        self.with_arm(arm, |a| {
            let before = a.failsafe.phase();
            let outcome = a.failsafe.ready(arm, &a.state, a.freshness(), now);
            if outcome == Outcome::Accepted && !matches!(before, Phase::Activating | Phase::Ready) {
                a.seed();
            }
            outcome
        })
    }

    fn stop(&mut self, arm: Option<u16>, now: Mono) -> Outcome {
        match arm {
            Some(arm) if arm as usize >= self.arms.len() => return Outcome::StartStateUnavailable(arm),
            Some(arm) => self.hold(arm as usize, Cause::Operator, now),
            None => (0..self.arms.len()).for_each(|i| self.hold(i, Cause::Operator, now)),
        }
        Outcome::Accepted
    }

    fn cancel(&mut self, which: Option<u16>) -> Outcome {
        if let Some(task) = which.filter(|&t| t as usize >= self.tasks.len()) {
            return Outcome::WrongTask(task);
        }
        let mut outcome = Outcome::AlreadyStopped;
        for t in 0..self.tasks.len() {
            if which.is_some_and(|w| w as usize != t) {
                continue;
            }
            if let Some(task) = self.tasks.get_mut(t)
                && let Some(motion) = task.cancel()
            {
                self.output.retired.extend(motion);
                outcome = Outcome::Cancelled;
                let event = Event::Task(t as u16, task.state, task.reason);
                self.output.tell(event);
            }
        }
        outcome
    }

    fn execute(&mut self, now: Mono, task: u16, motion: Box<Motion>) -> Outcome {
        let outcome = self.offer(now, task, &Target::Trajectory(&motion));
        let done = match self.tasks.get_mut(task as usize) {
            Some(t) if outcome == Outcome::Accepted => t.keep(motion),
            _ => Some(motion),
        };
        self.output.retired.extend(done);
        outcome
    }

    /// Offers a target to a task.
    fn offer(&mut self, now: Mono, task: u16, target: &Target<'_>) -> Outcome {
        self.try_offer(now, task, target).err().unwrap_or(Outcome::Accepted)
    }

    fn try_offer(&mut self, now: Mono, task: u16, target: &Target<'_>) -> Result<(), Outcome> {
        let t = self.tasks.get(task as usize).ok_or(Outcome::WrongTask(task))?;
        t.check(target)?;
        self.admit(match target {
            Target::Trajectory(motion) => &motion.joints,
            _ => &t.joints,
        })?;
        let t = self.tasks.get_mut(task as usize).ok_or(Outcome::WrongTask(task))?;
        if t.accept(now, self.period, &self.joints, target)? {
            self.output.tell(Event::Task(task, TaskState::Executing, Reason::None));
        }
        Ok(())
    }

    fn admit(&self, joints: &[u16]) -> Result<(), Outcome> {
        for &joint in joints {
            let arm = self.arm_of.get(joint as usize).copied().unwrap_or(u16::MAX);
            let Some(a) = self.arms.get(arm as usize) else { return Err(Outcome::StartStateUnavailable(arm)) };
            a.failsafe.admits(arm)?;
            if !a.fresh() {
                return Err(Outcome::StartStateUnavailable(arm));
            }
        }
        Ok(())
    }

    fn gripper(&mut self, arm: u16, opening: f64) -> Outcome {
        let Some(a) = self.arms.get_mut(arm as usize) else { return Outcome::StartStateUnavailable(arm) };
        if !a.config().gripper {
            return Outcome::NoGripper(arm);
        }
        if !opening.is_finite() || opening < 0.0 {
            return Outcome::OutOfLimits(a.first() as u16, opening);
        }
        match a.failsafe.admits(arm) {
            Ok(()) => {
                a.set_gripper(opening);
                Outcome::Accepted
            }
            Err(outcome) => outcome,
        }
    }

    /// Tasks with `auto_start` and a first target begin as soon as all arms are ready.
    fn start_by_themselves(&mut self, now: Mono) {
        if self.started || self.shutting_down || !self.arms.iter().all(|a| a.failsafe.phase() == Phase::Ready) {
            return;
        }
        self.started = true;
        for t in 0..self.tasks.len() {
            let Some(target) = self.tasks.get(t).and_then(Task::first_target) else { continue };
            let outcome = self.offer(now, t as u16, &target);
            self.output.tell(Event::Request(0, outcome));
        }
    }

    fn compute(&mut self, now: Mono) {
        for (t, task) in self.tasks.iter_mut().enumerate() {
            let before = (task.state, task.reason);
            let motion = task.compute(now, self.period, &self.joints);
            self.output.retired.extend(motion);
            if before != (task.state, task.reason) {
                self.output.tell(Event::Task(t as u16, task.state, task.reason));
            }
        }
    }

    fn route(&mut self, time: TickTime) {
        for task in &mut self.tasks {
            task.granted = !task.claims.is_empty();
        }
        for i in 0..self.arms.len() {
            let Some(arm) = self.arms.get_mut(i) else { continue };
            let (first, dof) = (arm.first(), arm.config().dof);
            let arbiter = &self.arbiter;
            let output = &mut self.output;
            let routed = arm.route(
                arbiter.demand(i),
                |j| {
                    let (_, value) = arbiter.winner(first + j)?;
                    Some(Ask { value, new_hands: arbiter.changed_hands(first + j) })
                },
                self.period,
                time.now,
                time.next,
                |j, kind, asked| output.tell(Event::Limited((first + j) as u16, kind, asked)),
            );
            if routed != Routed::Sent {
                for joint in first..first + dof {
                    if let Some((task, _)) = arbiter.winner(joint)
                        && let Some(t) = self.tasks.get_mut(task as usize)
                    {
                        t.granted = false;
                    }
                }
            }
            if let Some(at) = arm.gap() {
                for task in self.tasks.iter_mut().filter(|t| t.is_active()) {
                    if task.joints.iter().any(|&joint| (first..first + dof).contains(&usize::from(joint))) {
                        task.rewind(at, time.now);
                    }
                }
            }
            if let Routed::Refused(j, refusal) = routed {
                self.refuse(i, first + j, refusal, time.now);
            }
        }
    }

    /// A command was unfit: its task is at fault, and the arm holds.
    fn refuse(&mut self, arm: usize, joint: usize, refusal: Refusal, now: Mono) {
        if let Some((task, _)) = self.arbiter.winner(joint) {
            let reason = match refusal {
                Refusal::NonFinite => Reason::NonFinite(joint as u16),
                Refusal::Jump(step) => Reason::Jump(joint as u16, step),
            };
            self.end_task(task as usize, TaskState::Fault, reason);
        }
        self.hold(arm, ArmControl::cause_of(refusal), now);
    }

    fn publish(&mut self) {
        for (i, arm) in self.arms.iter().enumerate() {
            if let Some(command) = self.output.commands.get_mut(i) {
                *command = *arm.command();
            }
            self.output.arms.push(ArmSample {
                arm: i as u16,
                state: arm.measured(),
                command: *arm.command(),
                phase: arm.failsafe.phase(),
                cause: arm.failsafe.cause(),
            });
        }
        for (view, task) in self.output.tasks.iter_mut().zip(&self.tasks) {
            *view = task.view();
        }
    }
}
