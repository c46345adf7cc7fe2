//! One arm inside the tick: its feedback, its phase, the limiters of its joints, and how its commands are made: one
//! mode at a time, a hold per mode, a change of mode at standstill only.
//!
//! ```text
//! state ─▶ feedback ─▶ tracking ─▶ failsafe ─▶ phase ─┬─ ready ────────▶ follow ──┬─▶ command
//!                                                     ├─ held, standby ▶ rest ────┤
//!                                                     └─ led ──────────▶ led (none)
//! ```

mod delivery;
mod effort;
mod follow;
mod guarded;
mod led;
mod own_time;
mod rest;

use std::time::Duration;

use super::belief::feedback::Feedback;
use super::belief::plausibility::Verdict;
use super::belief::stalls::Stalls;
use super::belief::tracking::{Tracking, furthest};
use super::config::ArmConfig;
use super::failsafe::{Failsafe, Freshness};
use super::limit::{Limiter, Refusal};
use super::rest::{Rest, SETTLED, Start, braking};
use super::task_body::{Compliance, Demand};
use super::task_robot::FramePose;
use super::tool_limit::ToolLimiter;
use dimos_core::arm::{ArmCommand, ArmState, Link, Topology};
use dimos_core::clock::Mono;
use dimos_core::joint::{ControlMode, JointBounds, Joints, MAX_DOF};
use dimos_core::telemetry::{Bound, Cause, LedBy, LimitKind, Outcome, Phase};

/// A joint that moves this far while its arm is being enabled is moved by something else [rad]; so is one whose
/// readings agree for this time and cannot be true [s].
const ENABLING_TOLERANCE: f64 = 0.01;
const ENABLING_REJECTED: f64 = 0.008;

/// Part of the way that velocities have led to that measurements may correct, and the most at a time [rad].
const DRIFT: f64 = 0.05;
const MAX_CORRECTION: f64 = 0.05;

/// A joint that something else than setpoints moves (the arm's controller, or in impedance mode a hand) may have this
/// much more than its velocity limit.
const OVERSPEED: f64 = 1.1;
/// Time above that [s]: one velocity may be an estimate from noisy positions.
const TOO_FAST_FOR: f64 = 0.008;

use effort::Efforts;
pub use own_time::effective;

/// One arm inside the tick.
#[derive(Debug)]
pub struct ArmControl {
    config: ArmConfig,
    /// Index of its first joint over all arms.
    first: usize,
    feedback: Feedback,
    tracking: Tracking,
    /// Its phase.
    pub failsafe: Failsafe,
    limiters: Vec<Limiter>,
    /// The limiters before the requests of this tick.
    before: Vec<Limiter>,
    /// The limit that changed the joint's command in the last tick.
    limited: Vec<Option<LimitKind>>,
    tool: Option<ToolLimiter>,
    /// Whether the tool's speed limit changed the commands in the last tick, and in the one before.
    tool_limited: bool,
    tool_was_limited: bool,
    /// Per joint, the arm's own time that the last command covered, for each second here.
    pace: Joints,
    command: ArmCommand,
    /// Measured positions when the setpoint of the last start was taken [rad], and when that was.
    enabled_at: Joints,
    started_at: Mono,
    rest: Rest,
    /// Time of the last written setpoint before a gap that ended in this tick.
    resumed: Option<Mono>,
    /// Positions that velocities may still be corrected by measurements [rad].
    correction: f64,
    /// When the first of the readings was measured in which something else than setpoints moves a joint too fast.
    too_fast_since: Option<Mono>,
    /// What it is commanded beside positions; `None`: nothing.
    efforts: Option<Box<Efforts>>,
}

/// Request to one joint in this tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JointRequest {
    /// [rad] or [rad/s], by the arm's demand.
    pub value: f64,
    /// Whether another task won the joint in the previous tick.
    pub new_task: bool,
    /// Fraction of the velocity limit that applies, 0 to 1.
    pub speed: f64,
    /// The request does not slow down with the arm's controller alone: its task moves other arms, too.
    pub shared: bool,
    /// In impedance mode: what the task asks beside the position; `None`: the joint is held as the arm holds.
    pub compliance: Option<Compliance>,
}

/// Result of an arm's requests.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Routed {
    /// They were commanded, within limits.
    Sent,
    /// Not commanded yet: the arm changes its mode, starts, or nothing reaches it.
    Waiting,
    /// The arm takes no requests in its phase.
    NotReady,
    /// A request was refused: the joint of the arm, and the reason. The arm holds.
    Refused(usize, Refusal),
}

impl ArmControl {
    /// Creates the control of an arm without a state so far. `first`: index of its first joint over all arms.
    pub fn new(config: ArmConfig, first: usize, period: Duration) -> Self {
        let l = &config.limits;
        let bound = |j: usize| {
            let at = |list: &[f64], otherwise: f64| list.get(j).copied().unwrap_or(otherwise);
            JointBounds::inside(
                at(&l.position_lower, 0.0),
                at(&l.position_upper, 0.0),
                at(&l.velocity_max, 0.0),
                at(&l.acceleration_max, dimos_core::joint::DEFAULT_ACCELERATION),
            )
        };
        let limiters: Vec<Limiter> = (0..config.dof).map(|j| Limiter::new(bound(j))).collect();
        Self {
            before: limiters.clone(),
            limiters,
            limited: vec![None; config.dof],
            tool_limited: false,
            tool_was_limited: false,
            pace: [1.0; MAX_DOF],
            tool: config.tool.as_deref().map(ToolLimiter::new),
            feedback: Feedback::new(&config),
            tracking: Tracking::new(&config, period),
            rest: Rest::new(&config, period),
            efforts: Efforts::new(config.effort.as_deref()),
            config,
            first,
            failsafe: Failsafe::default(),
            command: ArmCommand::default(),
            enabled_at: [0.0; MAX_DOF],
            started_at: Mono::ZERO,
            resumed: None,
            correction: 0.0,
            too_fast_since: None,
        }
    }

    /// Returns its configuration.
    pub fn config(&self) -> &ArmConfig {
        &self.config
    }

    /// Returns the index of its first joint over all arms.
    pub fn first(&self) -> usize {
        self.first
    }

    /// Returns the velocity of a joint's last command [rad/s], in the time that passes here.
    pub fn commanded_velocity(&self, joint: usize) -> f64 {
        self.limiters.get(joint).map_or(0.0, Limiter::velocity) * self.pace.get(joint).copied().unwrap_or(1.0)
    }

    /// Replaces the tool whose speed is limited.
    pub fn set_tool(&mut self, tool: &FramePose) {
        self.tool.iter_mut().for_each(|limiter| limiter.set_tool(tool));
    }

    /// Returns the limit that changed the command of a joint (index over all arms) in the last tick.
    pub fn limited(&self, joint: usize) -> Option<Bound> {
        let kind = *self.limited.get(joint.checked_sub(self.first)?)?;
        Some(match if self.tool_limited { LimitKind::Tool } else { kind? } {
            LimitKind::Position => Bound::Position(joint as u16),
            LimitKind::Velocity => Bound::Velocity(joint as u16),
            LimitKind::Acceleration => Bound::Acceleration(joint as u16),
            LimitKind::Tool => Bound::Tool,
            // No effort limits a motion.
            LimitKind::Effort => return None,
        })
    }

    /// Returns the limiters of its joints.
    pub fn limiters(&self) -> &[Limiter] {
        &self.limiters
    }

    /// Returns the latest accepted state, with estimated velocities.
    pub fn state(&self) -> &ArmState {
        self.feedback.state()
    }

    /// Returns the state as it was read, for the log.
    pub fn measured(&self) -> ArmState {
        self.feedback.measured()
    }

    /// Returns whether the state is recent enough to act on, with its age.
    pub fn freshness(&self) -> Freshness {
        self.feedback.freshness()
    }

    /// Returns why the measured positions are not those of the arm at present; `None`: they are.
    pub fn unknown_position(&self) -> Cause {
        let (state, freshness) = (self.feedback.state(), self.feedback.freshness());
        match state.link {
            Link::Down | Link::Faulted => Cause::LinkLost,
            _ if state.error != 0 => Cause::Fault(state.error),
            _ if !freshness.fresh => Cause::Stale(freshness.age),
            _ => Cause::None,
        }
    }

    /// Returns why no other arm may follow it: its position is unknown, or what follows it stops with it.
    pub fn not_to_follow(&self) -> Cause {
        let cause = self.failsafe.cause();
        match self.unknown_position() {
            Cause::None if self.failsafe.phase() == Phase::Held && cause.stops_followers() => cause,
            unknown => unknown,
        }
    }

    /// Returns the distance of a joint from the range of its setpoints of the last `lag` seconds [rad].
    pub fn tracking_error(&self, joint: usize) -> f64 {
        self.tracking.error(joint)
    }

    /// Returns the last command.
    pub fn command(&self) -> &ArmCommand {
        &self.command
    }

    /// Returns whether a time without setpoints passes as if nothing had happened [s]: the arm's controller bridges it,
    /// or nothing moves the arm.
    pub fn bridges(&self, time: f64) -> bool {
        self.command.mode.is_none() || self.rest.written.bridges(time)
    }

    /// Returns whether it can decelerate by commands.
    pub fn can_brake(&self) -> bool {
        let state = self.feedback.state();
        let reached = state.enabled && state.link == Link::Up && self.rest.gap.is_none();
        reached && self.command.mode.is_some() && !self.at_rest()
    }

    /// Returns how far a joint at rest may be from where it is commanded [rad].
    pub fn rest_tolerance(&self) -> f64 {
        self.config.supervision.accuracy + self.config.supervision.droop
    }

    /// Returns whether no command moves the arm.
    pub fn at_rest(&self) -> bool {
        self.command.mode.is_none() || self.limiters.iter().all(Limiter::at_rest)
    }

    /// Takes the latest state. `stalls`: when the tick could not run. Returns whether the phase or its cause changed.
    pub fn read(&mut self, state: &ArmState, now: Mono, stalls: &Stalls, dt: f64) -> bool {
        let before = (self.failsafe.phase(), self.failsafe.cause());
        let native = self.failsafe.led_by() == Some(LedBy::Controller);
        let commanded = self.command.mode.is_some() && !self.is_starting();
        let range = if commanded { self.tracking.range(state) } else { None };
        let driven =
            commanded && self.rest.gap.is_none() && matches!(self.failsafe.phase(), Phase::Ready | Phase::Activating);
        let verdict = self.feedback.read(state, range.as_ref(), driven, now, stalls);
        self.take_written();
        self.failsafe.update(self.feedback.state(), self.feedback.freshness(), now);
        if let Some(cause) = self.disbelief(verdict) {
            self.failsafe.hold(cause, now);
        }
        if self.failsafe.phase() == Phase::Activating || self.is_starting() {
            self.take_start_pose(now);
            if self.is_starting() {
                self.failsafe.prolong_ramp(now);
            }
        }
        self.check_gap(now);
        self.hear_again();
        self.compare(dt);
        if let Some(cause) = self.unexpected_motion(dt) {
            self.failsafe.hold(cause, now);
        }
        // Its controller could continue when the other client releases it.
        self.rest.stop_pending |= native && self.failsafe.cause() == Cause::StoppedElsewhere;
        before != (self.failsafe.phase(), self.failsafe.cause())
    }

    /// Compares the latest positions with their setpoints, and corrects a little those that velocities have led to.
    fn compare(&mut self, dt: f64) {
        if self.is_starting() || self.command.mode.is_none() || self.rest.gap.is_some() {
            return self.tracking.clear_errors();
        }
        self.tracking.compare(self.feedback.state(), &self.limiters);
        if self.command.mode == Some(ControlMode::Velocity) && self.feedback.is_usable() {
            let fastest = self.limiters.iter().fold(0.0, |most: f64, limiter| most.max(limiter.velocity().abs()));
            self.correction = (self.correction + DRIFT * fastest * dt).min(MAX_CORRECTION);
            let (mut used, most) = (0.0f64, self.correction);
            let rests = self.at_rest() && self.feedback.rest_time() >= SETTLED;
            let read = self.feedback.state().position;
            for (j, (limiter, q)) in self.limiters.iter_mut().zip(read).enumerate() {
                let off = if rests { q - limiter.position() } else { self.tracking.error(j) };
                let by = off.max(-most).min(most);
                used = used.max(by.abs());
                limiter.correct(by);
            }
            self.correction -= used;
        }
    }

    /// Returns the cause for a hold if readings are confirmed to be false.
    fn disbelief(&self, verdict: Verdict) -> Option<Cause> {
        let seamed = |j: usize| self.config.supervision.topology.get(j) == Some(&Topology::Seamed);
        match verdict {
            Verdict::Same | Verdict::Accepted | Verdict::Rejected => None,
            Verdict::Jumped(joint, step) => Some(Cause::PositionJump(joint as u16, step)),
            Verdict::TurnLost(joint, _) if seamed(joint) => Some(Cause::SeamCrossed(joint as u16)),
            Verdict::TurnLost(joint, step) => Some(Cause::TurnLost(joint as u16, step)),
            Verdict::Inconsistent(joint, by) => Some(Cause::ReadingInconsistent(joint as u16, by)),
        }
    }

    /// Returns the joint that is furthest from where it was when the arm was enabled, and how far [rad]. The way back
    /// to its range does not count: a controller that takes no target outside moves a joint in that lies there.
    fn furthest_from_enabling(&self) -> (u16, f64) {
        let (state, limits) = (self.feedback.state(), &self.config.limits);
        let ranges = limits.position_lower.iter().zip(&limits.position_upper);
        let moved = state.position.iter().zip(&self.enabled_at).zip(ranges).map(|((q, before), (lower, upper))| {
            let moved = q - before;
            moved - moved.max((upper - before).min(0.0)).min((lower - before).max(0.0))
        });
        furthest(moved).unwrap_or_default()
    }

    /// Returns the cause for a hold if the arm moves without a command.
    fn unexpected_motion(&mut self, dt: f64) -> Option<Cause> {
        let state = self.feedback.state();
        let supervised = self.feedback.is_usable() && self.command.mode == Some(state.mode);
        match self.failsafe.phase() {
            Phase::Activating => {
                let s = &self.config.supervision;
                let limit = ENABLING_TOLERANCE.max(1.5 * s.accuracy).max(s.accuracy + s.droop);
                if let Some((joint, by)) = self.feedback.rejected_step(ENABLING_REJECTED) {
                    return Some(Cause::MovedWhileActivating(joint, by));
                }
                let (joint, by) = self.furthest_from_enabling();
                (by.abs() > limit).then_some(Cause::MovedWhileActivating(joint, by))
            }
            Phase::Ready if supervised && self.rest.gap.is_none() && !self.is_starting() => {
                if state.mode == ControlMode::Impedance {
                    // It yields: what may not be is that it is pushed, or jumps back, too fast.
                    self.tracking.pause();
                    return self.too_fast().map(|(joint, velocity)| Cause::TooFast(joint, velocity));
                }
                self.tracking.supervise(state, dt)
            }
            Phase::Led => {
                self.tracking.pause();
                self.led_trouble()
            }
            _ => {
                self.tracking.pause();
                None
            }
        }
    }

    /// Clears the latched hold, unless its cause persists. `arm`: the arm's index, for the outcome.
    pub fn reset(&mut self, arm: u16, now: Mono) -> Outcome {
        let cause = self.failsafe.cause();
        let outcome = self.failsafe.reset(arm, self.feedback.state(), self.feedback.freshness(), now);
        if outcome == Outcome::Accepted {
            self.rest.acknowledged |= matches!(cause, Cause::StartMismatch(..));
            if !matches!(cause, Cause::TurnLost(..)) {
                self.feedback.acknowledge();
            }
        }
        outcome
    }

    /// The arm was enabled: starts to hold it. An arm that still decelerates continues to do so. `arm`: the arm's
    /// index, for the outcome; `outside`: it may rest outside its position limits.
    pub fn activate(&mut self, arm: u16, outside: bool, now: Mono) -> Outcome {
        let before = self.failsafe.phase();
        let outcome = self.failsafe.on_enabled(arm, self.feedback.state(), self.feedback.freshness(), now);
        let begins = outcome == Outcome::Accepted && !matches!(before, Phase::Activating | Phase::Ready);
        if begins {
            self.rest.outside = outside;
        }
        if begins && self.command.mode.is_none() {
            let velocity = self.config.modes.first().copied().unwrap_or_default();
            self.start(self.config.position_mode().unwrap_or(velocity), now);
            self.enabled_at = self.feedback.state().position;
            self.rest.stop_pending = false;
        }
        outcome
    }

    /// Sets a new gripper position [m or rad], its largest force [N or Nm] and its speed, a fraction of the top speed;
    /// `None`: the device's own.
    pub fn set_gripper(&mut self, opening: f64, force: Option<f64>, speed: Option<f64>) {
        (self.command.gripper, self.command.gripper_force) = (opening, force);
        self.command.gripper_speed = speed;
        self.command.gripper_seq = self.command.gripper_seq.wrapping_add(1);
    }

    /// Makes the arm's next command, to be [issued](Self::issue). `ask` gives the request to each of its joints;
    /// `report` gets the joint, the limit and the request whenever a limit begins to change a command.
    pub fn route(
        &mut self,
        demand: Demand,
        ask: impl Fn(usize) -> Option<JointRequest>,
        dt: f64,
        now: Mono,
        next_tick: Mono,
        report: impl FnMut(usize, LimitKind, f64),
    ) -> Routed {
        self.command.seq += 1;
        (self.command.at, self.command.next_tick) = (now, next_tick);
        let phase = self.failsafe.phase();
        let held = phase == Phase::Held;
        self.command.led = phase == Phase::Led;
        // An arm that another program controls gets neither a setpoint nor a stop.
        let foreign = held && self.failsafe.cause().is_foreign();
        let braking = if self.at_rest() { 0.0 } else { braking::time(&self.limiters) };
        self.rest.enter(held, self.failsafe.cause(), braking, foreign);
        self.before.copy_from_slice(&self.limiters);
        self.tool_was_limited = std::mem::take(&mut self.tool_limited);
        self.efforts.iter_mut().for_each(|efforts| efforts.ask_nothing());
        match phase {
            Phase::Unknown | Phase::Disabled => {
                self.command.mode = None;
                Routed::NotReady
            }
            _ if !self.feedback.state().enabled || foreign => {
                self.command.mode = None;
                if foreign {
                    self.rest.forget_written();
                    if self.rest.stop_pending {
                        self.stop();
                    }
                }
                Routed::NotReady
            }
            _ if matches!(self.feedback.state().link, Link::Down | Link::Faulted) => {
                // It may still follow the last command: the device thread sends the stop as soon as it can.
                if self.command.mode.take().is_some() {
                    self.rest_where_written();
                    self.stop();
                }
                Routed::NotReady
            }
            Phase::Held | Phase::Standby => self.come_to_rest(demand, ask, now, dt),
            Phase::Activating => {
                if !matches!(self.rest.start, Start::Taking(..)) {
                    self.follow(Demand::Nothing, ask, dt, now, report);
                }
                Routed::NotReady
            }
            Phase::Led => {
                self.follow_measured();
                Routed::NotReady
            }
            Phase::Ready => self.follow(demand, ask, dt, now, report),
        }
    }

    /// Returns the cause of the latched hold for a refusal.
    pub fn cause_of(refusal: Refusal) -> Cause {
        match refusal {
            Refusal::NonFinite => Cause::NonFinite,
            Refusal::Jump(_) => Cause::Jump,
        }
    }
}
