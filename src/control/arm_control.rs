//! One arm inside the tick: its state as read, its phase, the limiters of its joints, and the way its commands
//! take: one mode at a time, a hold per mode, a mode switch only at standstill.

use super::config::ArmConfig;
use super::estimate::VelocityEstimator;
use super::failsafe::Failsafe;
use super::limit::{Bounds, Limiter, Refusal};
use super::task::Demand;
use crate::arm::{ArmCommand, ArmState, Link, VelocitySource};
use crate::clock::Mono;
use crate::joint::{ControlMode, Joints, MAX_DOF};
use crate::telemetry::{Cause, LimitKind, Phase};

/// A joint that measures no more than this is at a standstill for a change of mode [rad/s].
const STANDSTILL: f64 = 0.05;
/// How long an arm that lags gets to come to where its last command is, before it is asked to stop [s].
const SETTLING_LIMIT: f64 = 0.5;
/// Further than this from the last command, a re-activated arm is taken to have been moved by hand [rad].
const CARRIED_BY_POSITION_ERROR: f64 = 0.05;

/// One arm inside the tick.
#[derive(Debug)]
pub struct ArmControl {
    config: ArmConfig,
    /// Index of its first joint over all arms.
    first: usize,
    /// The latest state, with estimated velocities.
    pub state: ArmState,
    estimator: VelocityEstimator,
    fresh: bool,
    /// Its phase.
    pub failsafe: Failsafe,
    limiters: Vec<Limiter>,
    limited: Vec<bool>,
    command: ArmCommand,
    /// The last command still stands at the arm: it has been under power since.
    command_stands: bool,
    /// The arm is to be asked to stop by its own means, once it is at rest.
    stop_owed: bool,
    was_held: bool,
    /// How long its commands have been at rest [s].
    settling: f64,
}

/// What one joint is asked to do in this tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ask {
    /// [rad] or [rad/s], by the arm's demand.
    pub value: f64,
    /// It comes from another task than in the tick before.
    pub new_hands: bool,
}

/// What became of an arm's asks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Routed {
    /// They went out, within limits.
    Sent,
    /// Not yet: the arm is changing its mode.
    Waiting,
    /// The arm takes none in its phase.
    NotReady,
    /// One was unfit: which joint of the arm, and why. The arm holds.
    Refused(usize, Refusal),
}

impl ArmControl {
    /// An arm of which nothing is known yet.
    pub fn new(config: ArmConfig, first: usize) -> Self {
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
        Self {
            limiters: (0..config.dof).map(|j| Limiter::new(bound(j))).collect(),
            limited: vec![false; config.dof],
            config,
            first,
            state: ArmState::default(),
            estimator: VelocityEstimator::default(),
            fresh: false,
            failsafe: Failsafe::default(),
            command: ArmCommand::default(),
            command_stands: false,
            stop_owed: false,
            was_held: false,
            settling: 0.0,
        }
    }

    /// Its configuration.
    pub fn config(&self) -> &ArmConfig {
        &self.config
    }

    /// Index of its first joint over all arms.
    pub fn first(&self) -> usize {
        self.first
    }

    /// The limiters of its joints.
    pub fn limiters(&self) -> &[Limiter] {
        &self.limiters
    }

    /// Whether the latest state is recent enough to act on.
    pub fn fresh(&self) -> bool {
        self.fresh
    }

    /// Whether nothing that it commands moves.
    pub fn at_rest(&self) -> bool {
        self.command.mode.is_none() || self.limiters.iter().all(Limiter::at_rest)
    }

    /// Takes in the latest state. `true`: its phase changed.
    pub fn read(&mut self, state: &ArmState, now: Mono) -> bool {
        let dof = self.config.dof;
        let finite = |values: &Joints| values.iter().take(dof).all(|v| v.is_finite());
        let before = std::mem::replace(&mut self.state, *state);
        if !finite(&state.position) {
            // Positions that are not numbers are no measurement: the last one stays, and ages.
            (self.state.seq, self.state.stamp) = (before.seq, before.stamp);
            (self.state.position, self.state.velocity) = (before.position, before.velocity);
            (self.state.velocity_source, self.state.effort) = (before.velocity_source, before.effort);
        } else if !finite(&state.velocity) {
            self.state.velocity_source = VelocitySource::Absent;
        }
        self.estimator.fill(&mut self.state);
        self.fresh = self.state.seq != 0
            && self.state.link == Link::Up
            && now.since(self.state.stamp) <= self.config.state_timeout;
        if !self.state.enabled {
            self.command_stands = false;
        }
        self.failsafe.update(&self.state, self.fresh, now)
    }

    /// The arm was enabled: starts the hold. Where the arm has been under power since the last command and is
    /// still near it, that command stays: starting from the measured pose would sink a little at every enable. An
    /// arm that is still being brought to rest goes on with that.
    pub fn seed(&mut self) {
        if self.command.mode.is_some() {
            return;
        }
        for (limiter, q) in self.limiters.iter_mut().zip(&self.state.position) {
            let near = (limiter.position() - q).abs() <= CARRIED_BY_POSITION_ERROR;
            let start = if self.command_stands && near { limiter.position() } else { *q };
            limiter.seed(start);
        }
        self.stop_owed = false;
    }

    /// A new gripper opening [m].
    pub fn set_gripper(&mut self, opening: f64) {
        self.command.gripper = opening;
        self.command.gripper_seq = self.command.gripper_seq.wrapping_add(1);
    }

    /// The last command made.
    pub fn command(&self) -> &ArmCommand {
        &self.command
    }

    /// Makes the arm's next command. `ask` gives what each of its joints is asked; `tell` hears of limits that
    /// begin to bite.
    pub fn route(
        &mut self,
        demand: Demand,
        ask: impl Fn(usize) -> Option<Ask>,
        dt: f64,
        next_tick: Mono,
        tell: impl FnMut(usize, LimitKind, f64),
    ) -> Routed {
        self.command.seq += 1;
        self.command.next_tick = next_tick;
        let phase = self.failsafe.phase();
        let held = phase == Phase::Held;
        self.stop_owed |= held && !self.was_held;
        self.was_held = held;
        let routed = match phase {
            Phase::Unknown | Phase::Disabled => {
                self.command.mode = None;
                Routed::NotReady
            }
            _ if !self.state.enabled => {
                self.command.mode = None;
                Routed::NotReady
            }
            _ if matches!(self.state.link, Link::Down | Link::Faulted) => {
                // It may still follow the last command: the device thread stops it as soon as it gets through.
                if self.command.mode.take().is_some() {
                    self.stop();
                }
                Routed::NotReady
            }
            Phase::Held | Phase::Standby => {
                self.come_to_rest(dt);
                Routed::NotReady
            }
            Phase::Activating => {
                self.follow(Demand::Nothing, ask, dt, tell);
                Routed::NotReady
            }
            Phase::Ready => self.follow(demand, ask, dt, tell),
        };
        if self.command.mode.is_some() {
            self.command_stands = true;
        }
        routed
    }

    /// Slows down by commands; when at rest, asks the arm to stop by its own means and leaves it alone.
    fn come_to_rest(&mut self, dt: f64) {
        if let Some(mode) = self.command.mode {
            if !self.settled(dt) {
                return self.hold(mode, dt);
            }
            self.command.mode = None;
            self.stop_owed = true;
        }
        if self.stop_owed {
            self.stop();
        }
    }

    fn stop(&mut self) {
        self.stop_owed = false;
        self.settling = 0.0;
        self.command.stop_seq = self.command.stop_seq.wrapping_add(1);
    }

    /// Whether the arm has come to where its commands rest. A stop before that would make it hold short of the last
    /// command, and taking it up again would move it by the difference.
    fn settled(&mut self, dt: f64) -> bool {
        if !self.at_rest() {
            self.settling = 0.0;
            return false;
        }
        self.settling += dt;
        self.at_standstill() || !self.fresh || self.settling > SETTLING_LIMIT
    }

    fn follow(
        &mut self,
        demand: Demand,
        ask: impl Fn(usize) -> Option<Ask>,
        dt: f64,
        mut tell: impl FnMut(usize, LimitKind, f64),
    ) -> Routed {
        let Some(mode) = self.mode_for(demand) else {
            // It lacks the mode: what it does now must not stand.
            if let Some(present) = self.command.mode {
                self.hold(present, dt);
            }
            return Routed::NotReady;
        };
        if let Some(present) = self.command.mode.filter(|present| *present != mode) {
            if !self.at_standstill() {
                self.hold(present, dt);
                return Routed::Waiting;
            }
            // Each mode holds in its own way: positions from where the arm is, velocities from zero.
            if mode.is_position() {
                for (limiter, q) in self.limiters.iter_mut().zip(&self.state.position) {
                    limiter.seed(*q);
                }
            }
        }
        self.command.mode = Some(mode);
        if self.state.mode != mode {
            self.hold(mode, dt);
            return Routed::Waiting;
        }
        let mut before = [None; MAX_DOF];
        for (b, l) in before.iter_mut().zip(&self.limiters) {
            *b = Some(*l);
        }
        for (j, limiter) in self.limiters.iter_mut().enumerate() {
            let at = self.state.position.get(j).copied().unwrap_or_default();
            let value = match ask(j) {
                None if mode == ControlMode::Velocity => limiter.hold_velocity(at, dt),
                None => limiter.hold_position(dt),
                Some(ask) => {
                    if ask.new_hands {
                        limiter.hand_over();
                    }
                    let limited = match mode {
                        ControlMode::Velocity => limiter.follow_velocity(ask.value, at, dt),
                        _ => limiter.follow_position(ask.value, dt),
                    };
                    match limited {
                        Ok(limited) => {
                            if let Some(was) = self.limited.get_mut(j) {
                                if let (Some((kind, asked)), false) = (limited.by, *was) {
                                    tell(j, kind, asked);
                                }
                                *was = limited.by.is_some();
                            }
                            limited.value
                        }
                        Err(refusal) => {
                            for (l, b) in self.limiters.iter_mut().zip(before) {
                                *l = b.unwrap_or(*l);
                            }
                            self.hold(mode, dt);
                            return Routed::Refused(j, refusal);
                        }
                    }
                }
            };
            if let Some(out) = self.command.values.get_mut(j) {
                *out = value;
            }
        }
        Routed::Sent
    }

    fn mode_for(&self, demand: Demand) -> Option<ControlMode> {
        let velocity = self.config.modes.contains(&ControlMode::Velocity).then_some(ControlMode::Velocity);
        match demand {
            Demand::Velocities => velocity,
            Demand::Positions => self.config.position_mode(),
            Demand::Nothing => self.command.mode.or_else(|| self.config.position_mode()).or(velocity),
        }
    }

    fn at_standstill(&self) -> bool {
        let still = self.state.velocity.iter().take(self.config.dof).all(|v| v.abs() <= STANDSTILL);
        still && self.limiters.iter().all(Limiter::at_rest)
    }

    fn hold(&mut self, mode: ControlMode, dt: f64) {
        let joints = self.limiters.iter_mut().zip(&self.state.position).zip(self.command.values.iter_mut());
        for ((limiter, q), out) in joints {
            *out = match mode {
                ControlMode::Velocity => limiter.hold_velocity(*q, dt),
                _ => limiter.hold_position(dt),
            };
        }
    }

    /// The cause of a latched hold that a refusal stands for.
    pub fn cause_of(refusal: Refusal) -> Cause {
        match refusal {
            Refusal::NonFinite => Cause::NonFinite,
            Refusal::Jump(_) => Cause::Jump,
        }
    }
}
