//! One arm inside the tick: its feedback, its phase, the limiters of its joints, and how its commands are made: one
//! mode at a time, a hold per mode, a change of mode at standstill only.
//!
//! ```text
//! state ─▶ feedback ─▶ tracking ─▶ failsafe ─▶ phase ─┬─ ready ────────▶ follow ──┬─▶ command
//!                                                     ├─ held, standby ▶ rest ────┤
//!                                                     └─ led ──────────▶ led (none)
//! ```

mod delivery;
mod follow;
mod guarded;
mod led;
mod rest;

use std::time::Duration;

use super::config::ArmConfig;
use super::failsafe::{Failsafe, Freshness};
use super::feedback::Feedback;
use super::limit::{Bounds, Limiter, Refusal};
use super::plausibility::Verdict;
use super::stalls::Stalls;
use super::task_body::Demand;
use super::tracking::{Tracking, furthest};
use super::written::Written;
use crate::arm::{ArmCommand, ArmState, Link};
use crate::clock::Mono;
use crate::joint::{ControlMode, Joints, MAX_DOF};
use crate::telemetry::{Bound, Cause, LedBy, LimitKind, Outcome, Phase};
use rest::Rest;

/// A joint that moves this far while its arm is being enabled is moved by something else [rad].
const ENABLING_TOLERANCE: f64 = 0.02;

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
    command: ArmCommand,
    written: Written,
    /// Whether the arm still holds the positions that were written last: it has been under power since.
    holds_written: bool,
    /// Measured positions when the arm was enabled [rad].
    enabled_at: Joints,
    /// Whether it was enabled although it may rest outside its position limits.
    pub outside_allowed: bool,
    /// While the first setpoint after a start is not written: the number of its first command.
    starting: Option<u64>,
    /// While there is a gap in what is written: the number of the first command made from what had been written.
    gap_since: Option<u64>,
    /// The arm is on its way back to the last setpoint before a gap.
    returning: bool,
    rest: Rest,
    /// Consecutive readings in which the arm's own controller moved a joint too fast, and the number of the last one.
    led_too_fast: (u8, u64),
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
            Bounds::inside(
                at(&l.position_lower, 0.0),
                at(&l.position_upper, 0.0),
                at(&l.velocity_max, 0.0),
                at(&l.acceleration_max, crate::joint::DEFAULT_ACCELERATION),
            )
        };
        let limiters: Vec<Limiter> = (0..config.dof).map(|j| Limiter::new(bound(j))).collect();
        Self {
            before: limiters.clone(),
            limiters,
            limited: vec![None; config.dof],
            feedback: Feedback::new(&config),
            tracking: Tracking::new(&config, period),
            written: Written::new(period, config.write_period),
            config,
            first,
            failsafe: Failsafe::default(),
            command: ArmCommand::default(),
            holds_written: false,
            enabled_at: [0.0; MAX_DOF],
            outside_allowed: false,
            starting: None,
            gap_since: None,
            returning: false,
            rest: Rest::default(),
            led_too_fast: (0, 0),
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

    /// Returns the limit that changed the command of a joint (index over all arms) in the last tick.
    pub fn limited(&self, joint: usize) -> Option<Bound> {
        let kind = (*self.limited.get(joint.checked_sub(self.first)?)?)?;
        Some(match kind {
            LimitKind::Position => Bound::Position(joint as u16),
            LimitKind::Velocity => Bound::Velocity(joint as u16),
            LimitKind::Acceleration => Bound::Acceleration(joint as u16),
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

    /// Returns whether no command moves the arm.
    pub fn at_rest(&self) -> bool {
        self.command.mode.is_none() || self.limiters.iter().all(Limiter::at_rest)
    }

    /// Takes the latest state. `stalls`: when the tick could not run. Returns whether the phase or its cause changed.
    pub fn read(&mut self, state: &ArmState, now: Mono, stalls: &Stalls, dt: f64) -> bool {
        let before = (self.failsafe.phase(), self.failsafe.cause());
        let native = self.failsafe.led_by() == Some(LedBy::Controller);
        let verdict = self.feedback.read(state, now, stalls);
        self.take_written(now);
        self.failsafe.update(self.feedback.state(), self.feedback.freshness(), now);
        if let Verdict::Jumped(joint, step) = verdict {
            self.failsafe.hold(Cause::PositionJump(joint as u16, step), now);
        }
        if let Some(cause) = self.unexpected_motion(dt) {
            self.failsafe.hold(cause, now);
        }
        // Its controller could continue when the other client releases it.
        self.rest.stop_pending |= native && self.failsafe.cause() == Cause::StoppedElsewhere;
        before != (self.failsafe.phase(), self.failsafe.cause())
    }

    /// Returns the cause for a hold if the arm moves without a command.
    fn unexpected_motion(&mut self, dt: f64) -> Option<Cause> {
        let state = self.feedback.state();
        let supervised = self.feedback.is_usable() && self.command.mode == Some(state.mode);
        match self.failsafe.phase() {
            Phase::Activating => {
                let limit = ENABLING_TOLERANCE.max(2.0 * self.config.supervision.accuracy);
                let moved = state.position.iter().zip(&self.enabled_at).take(self.config.dof);
                let (joint, by) = furthest(moved.map(|(q, before)| q - before))?;
                (by.abs() > limit).then_some(Cause::MovedWhileActivating(joint, by))
            }
            Phase::Ready if supervised => {
                let velocity = self.command.mode == Some(ControlMode::Velocity);
                self.tracking.supervise(velocity, state, dt)
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
        self.failsafe.reset(arm, self.feedback.state(), self.feedback.freshness(), now)
    }

    /// The arm was enabled: starts to hold it. An arm that still decelerates continues to do so. `arm`: the arm's
    /// index, for the outcome; `outside`: it may rest outside its position limits.
    pub fn activate(&mut self, arm: u16, outside: bool, now: Mono) -> Outcome {
        let before = self.failsafe.phase();
        let outcome = self.failsafe.on_enabled(arm, self.feedback.state(), self.feedback.freshness(), now);
        let begins = outcome == Outcome::Accepted && !matches!(before, Phase::Activating | Phase::Ready);
        if begins {
            self.outside_allowed = outside;
        }
        if begins && self.command.mode.is_none() {
            self.start();
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
        self.rest.enter(held, foreign);
        self.check_gap(now);
        self.before.copy_from_slice(&self.limiters);
        match phase {
            Phase::Unknown | Phase::Disabled => {
                self.command.mode = None;
                Routed::NotReady
            }
            _ if !self.feedback.state().enabled || foreign => {
                self.command.mode = None;
                if foreign && self.rest.stop_pending {
                    self.stop();
                }
                Routed::NotReady
            }
            _ if matches!(self.feedback.state().link, Link::Down | Link::Faulted) => {
                // It may still follow the last command: the device thread sends the stop as soon as it can.
                if self.command.mode.take().is_some() {
                    self.stop();
                }
                Routed::NotReady
            }
            Phase::Held | Phase::Standby => {
                self.come_to_rest(now, dt);
                Routed::NotReady
            }
            Phase::Activating => {
                self.follow(Demand::Nothing, ask, dt, report);
                Routed::NotReady
            }
            Phase::Led => {
                self.follow_measured();
                Routed::NotReady
            }
            Phase::Ready => self.follow(demand, ask, dt, report),
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
