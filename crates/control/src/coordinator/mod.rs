//! The coordinator: `tick` turns the states of the arms and the pending requests into one command per arm. It neither
//! sleeps nor does I/O, takes no lock, allocates and frees nothing. The same states, requests and times give the same
//! commands, bit for bit.

mod guarding;
mod interruptions;
mod requests;
mod tick_output;

use std::time::Duration;

use super::arbitrate::Arbiter;
use super::arm_control::{ArmControl, JointRequest, Routed};
use super::belief::stalls::Stalls;
use super::config::CoordinatorConfig;
use super::guard::Guard;
use super::limit::Refusal;
use super::request::Envelope;
use super::speed_override::SpeedOverride;
use super::task::{Task, Tick};
use super::task_body::JointView;
use super::task_leader::gripper_target;
use dimos_core::arm::ArmState;
use dimos_core::clock::Mono;
use dimos_core::telemetry::{ArmSample, Bound, Cause, Event, LimitKind, Origin, Phase, Reason, TaskState};
use dimos_core::until::Sensed;

use interruptions::Watched;
pub use tick_output::{TickOutput, TickTime};

/// Maximum number of requests handled in one tick: the capacity of the ring, so that a flood of targets never delays a
/// stop.
const REQUESTS_PER_TICK: usize = 256;
/// Time stamps of a regular tick differ from its period by less than this part of it: they are rounded to ns.
const CLOCK_ROUNDING: f64 = 1e-3;
/// Time since the previous tick after which all arms are held [s].
const LOST_TIME: f64 = 0.1;
/// Consecutive overruns that are reported as degraded.
const DEGRADED_AFTER: u32 = 10;

/// The coordinator of all arms of a run.
#[derive(Debug)]
pub struct Coordinator {
    /// [s]
    period: f64,
    /// [ns]
    period_ns: u64,
    /// Time that this tick covers [s]: also skipped periods that the arms' controllers bridge.
    step: f64,
    /// Time of the last tick.
    ticked_at: Mono,
    arms: Vec<ArmControl>,
    tasks: Vec<Task>,
    arbiter: Arbiter,
    /// The arm of each joint.
    arm_of: Vec<u16>,
    joints: Vec<JointView>,
    sensed: Vec<Sensed>,
    overruns_in_a_row: u32,
    stalls: Stalls,
    speed: SpeedOverride,
    shutting_down: bool,
    started: bool,
    guard: Guard,
    /// Number of interruptions of all arms.
    epoch: u64,
    watched: Vec<Watched>,
    output: TickOutput,
}

impl Coordinator {
    /// Creates a coordinator with the tasks that [`TaskTable::build`](super::task_spec::TaskTable::build) made of the
    /// configuration. Allocates all memory that it will need.
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
        Self {
            period: 1.0 / config.rate,
            step: 1.0 / config.rate,
            ticked_at: Mono::ZERO,
            period_ns: Duration::from_secs_f64(1.0 / config.rate).as_nanos().max(1) as u64,
            arbiter: Arbiter::new(&priorities, arm_of.clone(), arms.len()),
            joints: vec![JointView::default(); arm_of.len()],
            sensed: vec![Sensed::default(); config.arms.len()],
            guard: Guard::new(arms.len()),
            epoch: 0,
            watched: vec![Watched::default(); arms.len()],
            output: TickOutput::new(arms.len(), tasks.len(), arm_of.len()),
            arms,
            tasks,
            arm_of,
            overruns_in_a_row: 0,
            stalls: Stalls::default(),
            speed: SpeedOverride::default(),
            shutting_down: false,
            started: false,
        }
    }

    /// Returns the tasks as of the last tick.
    pub fn tasks(&self) -> &[Task] {
        &self.tasks
    }

    /// Returns whether no command moves an arm.
    pub fn at_rest(&self) -> bool {
        self.arms.iter().all(ArmControl::at_rest) && !self.tasks.iter().any(Task::is_active)
    }

    /// Runs one tick. `states`: the latest state of each arm; `inbox`: returns the next pending request.
    pub fn tick(
        &mut self,
        time: TickTime,
        states: &[ArmState],
        mut inbox: impl FnMut() -> Option<Envelope>,
    ) -> &mut TickOutput {
        self.output.arms.clear();
        self.output.events.clear();
        // Empty in a run: the tick thread has drained it. A replay frees the motions here.
        self.output.retired.clear();
        let late = Duration::from_nanos(time.woke_late_ns);
        self.stalls.note(time.now.after(Duration::from_nanos(time.woke_late_ns % self.period_ns)), late);
        self.step = self.time_covered(time);
        self.read(time, states);
        self.account_for_lost_time(time);
        self.notice_interruptions();
        for _ in 0..REQUESTS_PER_TICK {
            let Some(envelope) = inbox() else { break };
            self.handle(time.now, envelope);
        }
        self.auto_start(time.now);
        self.compute(time.now);
        self.lead_grippers(time.now);
        let output = &mut self.output;
        let mut retired = std::mem::take(&mut output.retired);
        self.arbiter.decide(&mut self.tasks, |event| output.report(event), |motion| retired.push(motion));
        output.retired = retired;
        self.route(time);
        self.publish();
        &mut self.output
    }

    /// Returns the time that this tick covers [s]. What the controllers of all arms bridge passes as if nothing had
    /// happened: motions are where they would be. Ticks clocked by an arm may follow each other sooner after a pause.
    fn time_covered(&mut self, time: TickTime) -> f64 {
        let last = std::mem::replace(&mut self.ticked_at, time.now);
        let nominal = self.period * f64::from(time.skipped + 1);
        let passed = time.now.seconds_since(last);
        let sooner = last != Mono::ZERO && passed > 0.0 && passed < nominal - CLOCK_ROUNDING * self.period;
        let covered = if sooner { passed } else { nominal };
        if sooner && passed < self.period {
            return covered;
        }
        if self.arms.iter().all(|arm| arm.bridges(covered)) { covered } else { self.period }
    }

    fn read(&mut self, time: TickTime, states: &[ArmState]) {
        for (i, arm) in self.arms.iter_mut().enumerate() {
            let Some(state) = states.get(i) else { continue };
            if arm.read(state, time.now, &self.stalls, self.step) {
                let (phase, cause) = (arm.failsafe.phase(), arm.failsafe.cause());
                self.output.report(Event::Arm(i as u16, phase, cause));
            }
            if let Some(sensed) = self.sensed.get_mut(i) {
                *sensed = Sensed { wrench: arm.state().wrench, inputs: arm.state().inputs };
            }
            let fault = arm.not_to_follow();
            let droop = if arm.config().supervision.droop > 0.0 { arm.rest_tolerance() } else { 0.0 };
            let views = self.joints.iter_mut().skip(arm.first()).zip(arm.limiters());
            for (j, (view, limiter)) in views.enumerate() {
                *view = JointView {
                    position: arm.state().position.get(j).copied().unwrap_or_default(),
                    velocity: arm.state().velocity.get(j).copied().unwrap_or_default(),
                    effort: measured_effort(arm.state(), j),
                    commanded: limiter.position(),
                    commanded_velocity: arm.commanded_velocity(j),
                    lower: limiter.bounds().lower,
                    upper: limiter.bounds().upper,
                    acceleration: limiter.bounds().acceleration,
                    velocity_limit: limiter.bounds().velocity,
                    commanded_effort: commanded_effort(arm, j),
                    effort_limit: arm.config().effort.as_ref().and_then(|own| own.limits.max.get(j).copied()),
                    jerk: arm.config().limits.jerk_max.get(j).copied().unwrap_or(dimos_core::joint::DEFAULT_JERK),
                    tracking_error: arm.tracking_error(j),
                    droop,
                    speed_fraction: arm.state().speed_fraction,
                    arm: i as u16,
                    stamp: arm.state().stamp,
                    fault,
                };
            }
        }
        self.end_tasks_of_held_arms();
        self.resume_after_gaps(time.now);
    }

    /// Tasks of arms whose gap has ended continue from where the arms rest.
    fn resume_after_gaps(&mut self, now: Mono) {
        for i in 0..self.arms.len() {
            let Some((arm, at)) = self.arms.get(i).and_then(|arm| Some((arm, arm.resumed()?))) else { continue };
            let (joints, tolerance) = (arm.first()..arm.first() + arm.config().dof, arm.rest_tolerance());
            let tick = Tick { now, dt: self.step, speed: self.speed, views: &self.joints, sensed: &self.sensed };
            for t in 0..self.tasks.len() {
                let Some(task) = self.tasks.get_mut(t).filter(|task| task.is_active()) else { continue };
                if !task.moving_joints().iter().any(|joint| joints.contains(&usize::from(*joint))) {
                    continue;
                }
                if let Err((joint, by)) = task.rejoin(&tick, at, tolerance) {
                    self.end_task(t, TaskState::Aborted, Reason::Gap(joint, by, now.seconds_since(at)));
                    break;
                }
            }
        }
    }

    fn account_for_lost_time(&mut self, time: TickTime) {
        if time.skipped == 0 {
            self.overruns_in_a_row = 0;
            return;
        }
        self.output.report(Event::Overrun(time.skipped, time.late_ns));
        self.overruns_in_a_row += 1;
        if self.overruns_in_a_row == DEGRADED_AFTER {
            self.output.report(Event::Degraded);
        }
        let since_last = time.late_ns as f64 * 1e-9 + self.period;
        if since_last >= LOST_TIME.max(3.0 * self.period) {
            for i in 0..self.arms.len() {
                self.hold(i, Cause::Overrun, time.now);
            }
        }
    }

    /// Latches an arm's hold and ends its tasks.
    fn hold(&mut self, arm: usize, cause: Cause, now: Mono) {
        self.latch(arm, cause, now);
        self.end_tasks_of_held_arms();
    }

    /// Latches an arm's hold.
    fn latch(&mut self, arm: usize, cause: Cause, now: Mono) {
        if let Some(a) = self.arms.get_mut(arm) {
            let before = (a.failsafe.phase(), a.failsafe.cause());
            a.failsafe.hold(cause, now);
            if before != (a.failsafe.phase(), a.failsafe.cause()) {
                self.output.report(Event::Arm(arm as u16, a.failsafe.phase(), a.failsafe.cause()));
            }
        }
    }

    fn end_tasks_of_held_arms(&mut self) {
        for t in 0..self.tasks.len() {
            let Some(task) = self.tasks.get(t).filter(|t| t.is_active()) else { continue };
            let held = task.moving_joints().iter().find_map(|&joint| {
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
            let braking = matches!(reason, Reason::ArmHeld(arm, cause)
                if !cause.is_foreign() && self.arms.get(usize::from(arm)).is_some_and(ArmControl::can_brake));
            let motion = if braking { t.brake(state, reason) } else { t.end(state, reason) };
            self.output.retired.extend(motion);
            self.output.report(Event::Task(task as u16, state, reason));
        }
    }

    /// Starts tasks with `auto_start` and a first target as soon as all arms are ready. An arm that only leads may be
    /// disabled.
    fn auto_start(&mut self, now: Mono) {
        let ready = |arm: &ArmControl| arm.failsafe.phase() == Phase::Ready || self.only_leads(arm);
        if self.started || self.shutting_down || !self.arms.iter().all(ready) {
            return;
        }
        self.started = true;
        for t in 0..self.tasks.len() {
            let Some(target) = self.tasks.get(t).and_then(Task::first_target) else { continue };
            // The blueprint requested it when the run began.
            let outcome = self.offer(now, t as u16, &target, Some(Origin::default()));
            self.output.report(Event::Request(0, outcome));
        }
    }

    /// Returns whether tasks that start automatically follow an arm with a known position, and none of them moves it.
    fn only_leads(&self, arm: &ArmControl) -> bool {
        let joints = arm.first() as u16..(arm.first() + arm.config().dof) as u16;
        let starting = || self.tasks.iter().filter(|task| task.first_target().is_some());
        arm.unknown_position() == Cause::None
            && starting().any(|task| joints.clone().any(|joint| task.is_led_by(joint)))
            && !starting().any(|task| task.joints.iter().any(|joint| joints.contains(joint)))
    }

    fn compute(&mut self, now: Mono) {
        self.speed.advance(self.step);
        let tick = Tick { now, dt: self.step, speed: self.speed, views: &self.joints, sensed: &self.sensed };
        for (t, task) in self.tasks.iter_mut().enumerate() {
            let before = (task.state, task.reason);
            let motion = task.compute(&tick);
            self.output.retired.extend(motion);
            if before != (task.state, task.reason) {
                self.output.report(Event::Task(t as u16, task.state, task.reason));
            }
        }
    }

    /// Commands the grippers of arms that follow another arm.
    fn lead_grippers(&mut self, now: Mono) {
        for task in &mut self.tasks {
            let Some((joint, leader)) = task.led_gripper(now) else { continue };
            let of = |joint: u16| self.arm_of.get(joint as usize).map(|arm| usize::from(*arm));
            let Some((own, leader)) = of(joint).zip(of(leader)) else { continue };
            let Some((position, info)) =
                self.arms.get(leader).and_then(|a| Some((a.state().gripper?, a.config().gripper_info)))
            else {
                continue;
            };
            let Some(arm) = self.arms.get_mut(own).filter(|arm| arm.config().gripper) else { continue };
            let last = (arm.command().gripper_seq != 0).then_some(arm.command().gripper);
            if let Some(target) = gripper_target(position, &info, &arm.config().gripper_info, last) {
                arm.set_gripper(target, None, None);
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
            let (arbiter, tasks, pace) = (&self.arbiter, &self.tasks, self.speed.of_streams());
            let output = &mut self.output;
            let routed = arm.route(
                arbiter.demand(i),
                |j| {
                    let (task, value) = arbiter.winner(first + j)?;
                    let task = tasks.get(task as usize)?;
                    let speed = if task.applies_speed() { 1.0 } else { pace };
                    let new_task = arbiter.winner_changed(first + j);
                    let compliance = task.compliance((first + j) as u16);
                    Some(JointRequest { value, new_task, speed, shared: task.shares_time, compliance })
                },
                self.step,
                time.now,
                time.next,
                |j, kind, asked| output.report(Event::Limited((first + j) as u16, kind, asked)),
            );
            self.guard.note(i, routed == Routed::Sent);
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
                    if task.moving_joints().iter().any(|&joint| (first..first + dof).contains(&usize::from(joint))) {
                        task.rewind(at, time.now);
                    }
                }
            }
            if let Routed::Refused(j, refusal) = routed {
                self.refuse(i, first + j, refusal, time.now);
            }
        }
        self.guard();
        let dt = self.period;
        let output = &mut self.output;
        for arm in &mut self.arms {
            let first = arm.first();
            arm.issue(time.now, dt, |j, asked| {
                output.report(Event::Limited((first + j) as u16, LimitKind::Effort, asked));
            });
        }
    }

    /// Ends the task whose request was refused with a fault, and holds the arm.
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
        self.notice_interruptions();
        self.output.epoch = self.epoch;
        self.output.speed = self.speed;
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
            let guarded = |joint: &u16| self.guard.blocked(self.arm_of.get(usize::from(*joint)).copied()?);
            if let Some(pair) = task.moving_joints().iter().find_map(guarded).filter(|_| task.is_active()) {
                view.bound = Bound::Guard(pair);
            } else if view.bound == Bound::None && task.granted && task.is_active() {
                let limited = |joint: &u16| self.arms.iter().find_map(|arm| arm.limited(usize::from(*joint)));
                view.bound = task.moving_joints().iter().find_map(limited).unwrap_or_default();
            }
        }
    }
}

/// Returns the measured effort of a joint, if the arm reports it and its motor answers.
fn measured_effort(state: &ArmState, joint: usize) -> Option<f64> {
    state.effort.filter(|_| !state.missing.contains(joint)).and_then(|effort| effort.get(joint).copied())
}

/// Returns the effort that the last command has for a joint.
fn commanded_effort(arm: &ArmControl, joint: usize) -> Option<f64> {
    let command = arm.command();
    command.effort.filter(|_| command.mode.is_some()).and_then(|effort| effort.get(joint).copied())
}
