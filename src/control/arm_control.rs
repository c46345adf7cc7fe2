//! One arm inside the tick: its state as read, its phase, the limiters of its joints, and the way its commands
//! take: one mode at a time, a hold per mode, a mode switch only at standstill.

use std::time::Duration;

use super::belief::{Belief, Verdict};
use super::config::ArmConfig;
use super::estimate::VelocityEstimator;
use super::failsafe::{Failsafe, Freshness};
use super::limit::{Bounds, Limiter, Refusal};
use super::set_points::{Range, SetPoints};
use super::stalls::Stalls;
use super::task_body::Demand;
use super::written::{Issued, Written};
use crate::arm::{ArmCommand, ArmState, Link, VelocitySource};
use crate::clock::Mono;
use crate::joint::{ControlMode, Joints, MAX_DOF, TICK_STANDSTILL};
use crate::telemetry::{Age, Cause, LimitKind, Phase};

/// How long an arm that lags gets to come to where its last command is, before it is asked to stop [s].
const SETTLING_LIMIT: f64 = 0.5;
/// A joint that moves this far while its arm is being enabled does so for another reason [rad].
const MOVED: f64 = 0.02;
/// How long a joint may be too far from its setpoints before the arm is held [s]: positions, velocities.
const TRACKING_LIMIT: (f64, f64) = (0.1, 0.2);
/// In velocity mode, how far the measured velocity may be from the setpoints [rad/s], and as a part of itself.
const VELOCITY_TOLERANCE: (f64, f64) = (0.2, 0.2);
/// A held joint at rest further than this from its setpoints, besides its accuracy, has its setpoint drawn to
/// it [rad].
const DRAW: f64 = 0.04;
/// How long that takes at most, within the joint's top speed [s].
const DRAW_TIME: f64 = 0.1;
/// The longest delay of this computer that is not taken for a state's age.
const LONGEST_DELAY: Duration = Duration::from_millis(100);

/// One arm inside the tick.
#[derive(Debug)]
pub struct ArmControl {
    config: ArmConfig,
    /// Index of its first joint over all arms.
    first: usize,
    /// The latest state that is believed, with estimated velocities.
    pub state: ArmState,
    /// The latest state as it was read, while it is not believed.
    raw: Option<ArmState>,
    belief: Belief,
    estimator: VelocityEstimator,
    freshness: Freshness,
    /// Its phase.
    pub failsafe: Failsafe,
    limiters: Vec<Limiter>,
    limited: Vec<bool>,
    command: ArmCommand,
    written: Written,
    set_points: SetPoints,
    /// The positions that were written last still stand at the arm: it has been under power since.
    standing: bool,
    /// Where the joints were measured when the arm was enabled.
    seed: Joints,
    /// The first setpoint after a start was not written yet: the sequence number of its first command.
    starting: Option<u64>,
    /// Nothing reached the arm for more than two periods, or what did is not what is commanded: the first command that
    /// was made from what had been written.
    gap_since: Option<u64>,
    /// How far each joint is outside the range of its setpoints of the last `lag` seconds [rad]; 0 in velocity mode.
    tracking_errors: Joints,
    /// `supervision.lag`.
    lag: Duration,
    /// How far each joint coasts beyond the last setpoint that it got before a gap [rad], and for how long that counts.
    coast: (Joints, Mono),
    /// How long a joint has been too far from its setpoints [s].
    astray: f64,
    /// Time left to draw setpoints to the measured pose [s].
    drawing: f64,
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
    pub fn new(config: ArmConfig, first: usize, period: Duration) -> Self {
        let l = &config.limits;
        let own = if config.own_velocity.len() == config.dof { &config.own_velocity } else { &l.velocity_max };
        let read = config.read_period.max(Duration::from_micros(100));
        let belief = Belief::new(own, &l.position_lower, &l.position_upper, read.as_secs_f64());
        let window = config.supervision.lag + config.supervision.stale_after.as_secs_f64() + 2.0 * period.as_secs_f64();
        let lag = Duration::from_secs_f64(config.supervision.lag);
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
            set_points: SetPoints::new(config.dof, window),
            written: Written::new(period, config.write_period),
            config,
            first,
            state: ArmState::default(),
            raw: None,
            belief,
            estimator: VelocityEstimator::default(),
            freshness: Freshness::default(),
            failsafe: Failsafe::default(),
            command: ArmCommand::default(),
            standing: false,
            seed: [0.0; MAX_DOF],
            starting: None,
            gap_since: None,
            tracking_errors: [0.0; MAX_DOF],
            lag,
            coast: ([0.0; MAX_DOF], Mono::ZERO),
            astray: 0.0,
            drawing: DRAW_TIME,
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
        self.freshness.fresh
    }

    /// Whether the latest state is recent enough to act on, with its age.
    pub fn freshness(&self) -> Freshness {
        self.freshness
    }

    /// The state as it was read, refused positions included, with estimated velocities: for the log.
    pub fn measured(&self) -> ArmState {
        match &self.raw {
            // What is not a number is no measurement.
            Some(raw) if raw.position.iter().take(self.config.dof).all(|q| q.is_finite()) => {
                ArmState { velocity: self.state.velocity, velocity_source: self.state.velocity_source, ..*raw }
            }
            _ => self.state,
        }
    }

    /// When nothing reached the arm for too long: the time of the command that was written last.
    pub fn gap(&self) -> Option<Mono> {
        self.gap_since.map(|_| self.written.last().at)
    }

    /// How far a joint is outside the range of its setpoints of the last `lag` seconds [rad]; 0 inside, and in velocity
    /// mode.
    pub fn tracking_error(&self, joint: usize) -> f64 {
        self.tracking_errors.get(joint).copied().unwrap_or_default()
    }

    /// Compares the latest positions with their setpoints.
    fn compare(&mut self) {
        self.tracking_errors = [0.0; MAX_DOF];
        if !self.command.mode.is_some_and(ControlMode::is_position) || self.starting.is_some() {
            return;
        }
        // The newest setpoint is in every window.
        let near = |(q, limiter): (&f64, &Limiter)| (q - limiter.position()).abs() <= DRAW / 4.0;
        if self.state.position.iter().zip(&self.limiters).all(near) {
            return;
        }
        let Some(range) = self.set_points.range(self.window_start()) else { return };
        let coasting = self.state.stamp < self.coast.1;
        let joints = self.state.position.iter().zip(&self.limiters).zip(&self.coast.0).enumerate();
        for ((j, ((q, limiter), coast)), error) in joints.zip(&mut self.tracking_errors) {
            if near((q, limiter)) {
                continue;
            }
            let distance = range.distance(j, *q);
            *error = if coasting && coast * distance > 0.0 {
                distance - distance.clamp(-coast.abs(), coast.abs())
            } else {
                distance
            };
        }
    }

    /// Where the setpoints begin that the latest state may still be following.
    fn window_start(&self) -> Mono {
        self.state.stamp.before(self.lag)
    }

    /// Whether nothing that it commands moves.
    pub fn at_rest(&self) -> bool {
        self.command.mode.is_none() || self.limiters.iter().all(Limiter::at_rest)
    }

    /// Takes in the latest state. `stalls`: when the tick could not run. `true`: its phase changed.
    pub fn read(&mut self, state: &ArmState, now: Mono, stalls: &Stalls, dt: f64) -> bool {
        let before = (self.failsafe.phase(), self.failsafe.cause());
        let verdict = self.take(state);
        self.estimator.fill(&mut self.state);
        self.freshness = self.age(now, stalls);
        self.written.report(self.state.written);
        // An arm whose connection broke has stopped by its own means, elsewhere.
        if !self.state.enabled || matches!(self.state.link, Link::Down | Link::Faulted) {
            self.standing = false;
        }
        // Before anything is compared with the setpoints: an arm that got none is beyond the last one.
        let moved = self.starting.is_none() && self.command.mode.is_some_and(ControlMode::is_position);
        if moved && self.gap_since.is_none() && self.written.gap(now) {
            self.begin_to_coast(now);
        }
        self.compare();
        self.failsafe.update(&self.state, self.freshness, now);
        if let Verdict::Jumped(joint, step) = verdict {
            self.failsafe.hold(Cause::PositionJump(joint as u16, step), now);
        }
        if let Some(cause) = self.strayed(dt) {
            self.failsafe.hold(cause, now);
        }
        before != (self.failsafe.phase(), self.failsafe.cause())
    }

    /// Takes what is believed of a state.
    fn take(&mut self, state: &ArmState) -> Verdict {
        let finite = |values: &Joints| values.iter().take(self.config.dof).all(|v| v.is_finite());
        // Positions that are not numbers are no measurement.
        let verdict = if finite(&state.position) { self.belief.take(state) } else { Verdict::Refused };
        if verdict == Verdict::Refused || (verdict == Verdict::Same && self.belief.refused() > 0) {
            // The last believed measurement stays, and ages.
            self.raw = Some(*state);
            let before = std::mem::replace(&mut self.state, *state);
            (self.state.seq, self.state.stamp) = (before.seq, before.stamp);
            (self.state.position, self.state.velocity) = (before.position, before.velocity);
            (self.state.velocity_source, self.state.effort) = (before.velocity_source, before.effort);
            return verdict;
        }
        self.raw = None;
        self.state = *state;
        if !finite(&state.velocity) {
            self.state.velocity_source = VelocitySource::Absent;
        }
        verdict
    }

    /// The age of the state that is believed, without the time in which this computer could not have seen a newer one.
    fn age(&self, now: Mono, stalls: &Stalls) -> Freshness {
        let limit = self.config.supervision.stale_after.max(3 * self.config.read_period);
        // While readings are refused, the arm still answers: they have three readings to agree with each other.
        let waiting = 3 * self.config.read_period.max(Duration::from_millis(1));
        let refused = self.belief.refused() > 0 && now.since(self.belief.stamp()) <= limit + waiting;
        let stamp = self.raw.as_ref().filter(|_| refused).map_or(self.state.stamp, |raw| raw.stamp);
        let age = now.since(stamp);
        let device = Duration::from_nanos(self.state.own_delay_ns);
        let device = if device < LONGEST_DELAY { device } else { Duration::ZERO };
        let own = stalls.between(stamp, now).max(device).min(age);
        let seen = age - own;
        let us = |d: Duration| d.as_micros().min(u128::from(u32::MAX)) as u32;
        let fresh = self.state.seq != 0 && self.state.link == Link::Up && seen <= limit;
        Freshness { fresh, age: Age { age_us: us(seen), limit_us: us(limit), own_us: us(own) } }
    }

    /// Returns why the arm must be held, if it moves without a command.
    fn strayed(&mut self, dt: f64) -> Option<Cause> {
        let measured = self.freshness.fresh && self.belief.refused() == 0;
        let supervised = measured && self.command.mode == Some(self.state.mode) && !self.set_points.is_empty();
        match self.failsafe.phase() {
            Phase::Activating if measured => {
                let limit = MOVED.max(2.0 * self.config.supervision.accuracy);
                let moved = self.state.position.iter().zip(&self.seed).take(self.config.dof).map(|(q, seed)| q - seed);
                let (joint, by) = furthest(moved)?;
                (by.abs() > limit).then_some(Cause::MovedWhileActivating(joint, by))
            }
            Phase::Ready if supervised => {
                let velocity = self.command.mode == Some(ControlMode::Velocity);
                let (joint, by) = if velocity {
                    let range = self.set_points.range(self.window_start())?;
                    furthest((0..self.config.dof).map(|j| self.velocity_error(&range, j)))?
                } else {
                    furthest(self.tracking_errors.iter().copied().take(self.config.dof))?
                };
                let tolerance = if velocity { 0.0 } else { self.config.supervision.tracking_tolerance };
                self.astray = if by.abs() > tolerance { self.astray + dt } else { 0.0 };
                let limit = if velocity { TRACKING_LIMIT.1 } else { TRACKING_LIMIT.0 };
                (self.astray > limit).then_some(Cause::Tracking(joint, by))
            }
            _ => {
                self.astray = 0.0;
                None
            }
        }
    }

    /// How far a joint's velocity is beyond the tolerance around its setpoints of the last `lag` seconds [rad/s].
    fn velocity_error(&self, range: &Range, joint: usize) -> f64 {
        let Some(v) = self.state.velocity.get(joint) else { return 0.0 };
        let tolerance = VELOCITY_TOLERANCE.0.max(VELOCITY_TOLERANCE.1 * v.abs());
        let distance = range.distance(joint, *v);
        if distance.abs() > tolerance { distance } else { 0.0 }
    }

    /// The arm was enabled: starts the hold. An arm that still decelerates continues to do so.
    pub fn seed(&mut self) {
        if self.command.mode.is_some() {
            return;
        }
        self.start();
        self.seed = self.state.position;
        self.stop_owed = false;
    }

    /// From here on the commands do not continue the ones before: the first of them must be where the arm is.
    fn start(&mut self) {
        self.command.start_seq = self.command.start_seq.wrapping_add(1);
        self.starting = Some(self.command.seq + 1);
        self.set_points.clear();
        self.astray = 0.0;
        self.drawing = DRAW_TIME;
        self.seed_limiters();
    }

    /// Where the arm has been under power since the last position was written, and is at it within its accuracy, that
    /// position stays: starting from the measured pose would sink a little at every start. Otherwise it starts from
    /// where it is measured.
    fn seed_limiters(&mut self) {
        for (j, limiter) in self.limiters.iter_mut().enumerate() {
            let q = self.state.position.get(j).copied().unwrap_or_default();
            let stands = self.written.last().position.get(j).copied().filter(|_| self.standing);
            let near = |stands: &f64| (stands - q).abs() <= 2.0 * self.config.supervision.accuracy;
            limiter.seed(stands.filter(near).unwrap_or(q));
        }
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
        now: Mono,
        next_tick: Mono,
        tell: impl FnMut(usize, LimitKind, f64),
    ) -> Routed {
        self.command.seq += 1;
        (self.command.at, self.command.next_tick) = (now, next_tick);
        let phase = self.failsafe.phase();
        let held = phase == Phase::Held;
        // What somebody else does with the arm is theirs to end: it gets no setpoint and no stop.
        let foreign = held && self.failsafe.cause().is_foreign();
        self.stop_owed |= held && !self.was_held && !foreign;
        self.was_held = held;
        self.note_gap(now);
        let routed = match phase {
            Phase::Unknown | Phase::Disabled => {
                self.command.mode = None;
                Routed::NotReady
            }
            _ if !self.state.enabled || foreign => {
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
                self.come_to_rest(now, dt);
                Routed::NotReady
            }
            Phase::Activating => {
                self.follow(Demand::Nothing, ask, dt, tell);
                Routed::NotReady
            }
            Phase::Ready => self.follow(demand, ask, dt, tell),
        };
        self.issue(now);
        routed
    }

    /// Keeps what leaves the tick, to know later what reached the arm.
    fn issue(&mut self, now: Mono) {
        let Some(mode) = self.command.mode else { return };
        let mut issued = Issued { seq: self.command.seq, at: now, position: [0.0; MAX_DOF], velocity: [0.0; MAX_DOF] };
        let out = issued.position.iter_mut().zip(&mut issued.velocity);
        for ((q, v), limiter) in out.zip(&self.limiters) {
            (*q, *v) = (limiter.position(), limiter.velocity());
        }
        self.written.issue(issued);
        self.set_points.push(now, &self.command.values);
        self.standing &= mode.is_position();
    }

    /// An arm at speed that gets no setpoint stops on its own beyond the last one, and then returns to it.
    fn begin_to_coast(&mut self, now: Mono) {
        let mut longest = 0.0f64;
        for (coast, limiter) in self.coast.0.iter_mut().zip(&self.limiters) {
            let (v, a) = (limiter.velocity(), limiter.bounds().acceleration);
            *coast = v * v.abs() / (2.0 * a);
            longest = longest.max(v.abs() / a);
        }
        let time = (2.0 * longest + self.config.supervision.lag).clamp(0.0, 60.0);
        self.coast.1 = now.after(Duration::from_secs_f64(time));
    }

    /// Finds out whether what is commanded reaches the arm. Where it does not, the commands go back to what did.
    fn note_gap(&mut self, now: Mono) {
        if let Some(first) = self.starting {
            // Until the first setpoint is written, each tick makes it again from the newest measurement.
            if self.state.written >= first
                && let Some(mode) = self.command.mode
            {
                self.starting = None;
                self.standing = mode.is_position();
            } else {
                self.seed_limiters();
            }
        }
        let moved = self.starting.is_none() && self.command.mode.is_some();
        // A command from before the gap may still have been written after its beginning was seen.
        let late = self.gap_since.is_some_and(|first| self.written.last().seq < first);
        if !(moved && (late || self.written.gap(now))) {
            self.gap_since = None;
            return;
        }
        self.gap_since.get_or_insert(self.command.seq);
        let rest = self.command.mode.is_some_and(ControlMode::is_position);
        let last = self.written.last();
        for (limiter, (q, v)) in self.limiters.iter_mut().zip(last.position.iter().zip(&last.velocity)) {
            // Joints that follow positions are at rest at the last one; velocities continue.
            limiter.rewind(*q, if rest { 0.0 } else { *v });
        }
    }

    /// Slows down by commands; when at rest, asks the arm to stop by its own means and leaves it alone.
    fn come_to_rest(&mut self, now: Mono, dt: f64) {
        if let Some(mode) = self.command.mode {
            // A velocity that cannot be reduced, because nothing gets through, continues: the stop replaces it. After a
            // short gap the ramp continues.
            let silent = now.since(self.written.last().at) > self.config.supervision.stale_after;
            let stuck = self.gap_since.is_some() && silent && mode == ControlMode::Velocity;
            let drawn = mode.is_position() && self.draw(dt);
            if drawn || !(stuck || self.settled(dt)) {
                return self.hold(mode, dt);
            }
            self.command.mode = None;
            self.stop_owed = true;
        }
        if self.stop_owed {
            self.stop();
        }
    }

    /// Draws the setpoints of joints that do not follow them to where they are. `true`: there are such joints.
    fn draw(&mut self, dt: f64) -> bool {
        let tolerance = DRAW + self.config.supervision.accuracy;
        let mut drawn = false;
        // A position that jumped may be wrong: no setpoint is made from it before a reset.
        if matches!(self.failsafe.cause(), Cause::PositionJump(..)) || self.belief.refused() > 0 {
            return false;
        }
        self.drawing = (self.drawing - dt).max(dt);
        for j in 0..self.config.dof {
            // One that still moves is on its way, and its setpoint is brought to rest like any other.
            let stands = self.state.velocity.get(j).is_none_or(|v| v.abs() <= TICK_STANDSTILL);
            let off = stands && self.tracking_error(j).abs() > tolerance;
            let q = self.state.position.get(j).copied().unwrap_or_default();
            if let Some(limiter) =
                self.limiters.get_mut(j).filter(|_| off && self.freshness.fresh && self.gap_since.is_none())
            {
                let step = (q - limiter.position()).abs() * dt / self.drawing;
                limiter.draw(q, step.min(limiter.bounds().velocity * dt));
                drawn = true;
            }
        }
        drawn
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
        self.at_standstill() || !self.freshness.fresh || self.settling > SETTLING_LIMIT
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
            self.standing &= present.is_position();
            self.start();
        }
        self.command.mode = Some(mode);
        if self.state.mode != mode || self.starting.is_some() {
            self.hold(mode, dt);
            return Routed::Waiting;
        }
        if self.gap_since.is_some() {
            return self.wait_for_the_wire(mode, ask, dt);
        }
        if let Some((j, refusal)) = self.refused(mode, &ask) {
            self.hold(mode, dt);
            return Routed::Refused(j, refusal);
        }
        let ahead = if mode == ControlMode::Velocity { self.ahead(dt) } else { None };
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
                        ControlMode::Velocity => {
                            let within = ahead.as_ref().and_then(|a| a.get(j)).copied().unwrap_or((at, at));
                            limiter.follow_velocity(ask.value, within, dt)
                        }
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
                        // Asked above.
                        Err(refusal) => return Routed::Refused(j, refusal),
                    }
                }
            };
            if let Some(out) = self.command.values.get_mut(j) {
                *out = value;
            }
        }
        Routed::Sent
    }

    /// Nothing reaches the arm: its last setpoint is repeated. Requests continue, so that a jump in them shows.
    fn wait_for_the_wire(&mut self, mode: ControlMode, ask: impl Fn(usize) -> Option<Ask>, dt: f64) -> Routed {
        let mut refused = None;
        for (j, limiter) in self.limiters.iter_mut().enumerate() {
            if let (Some(ask), true) = (ask(j), mode.is_position()) {
                refused = refused.or(limiter.pass(ask.value).err().map(|refusal| (j, refusal)));
            }
            if let Some(out) = self.command.values.get_mut(j) {
                *out = if mode == ControlMode::Velocity { limiter.velocity() } else { limiter.position() };
            }
        }
        match refused {
            Some((j, refusal)) => {
                self.hold(mode, dt);
                Routed::Refused(j, refusal)
            }
            None => Routed::Waiting,
        }
    }

    /// Where each joint may be by the time a velocity command takes effect [rad], lowest and highest: the measurement
    /// is old, and the joint still follows what was commanded since.
    fn ahead(&self, dt: f64) -> Option<[(f64, f64); MAX_DOF]> {
        let range = self.set_points.range(self.window_start())?;
        let age = f64::from(self.freshness.age.age_us + self.freshness.age.own_us) * 1e-6;
        let time = self.config.supervision.lag + age + dt;
        let mut out = [(0.0, 0.0); MAX_DOF];
        for (out, (q, (low, high))) in
            out.iter_mut().zip(self.state.position.iter().zip(range.low.iter().zip(&range.high)))
        {
            *out = (q + low.min(0.0) * time, q + high.max(0.0) * time);
        }
        Some(out)
    }

    /// The first of an arm's asks that is unfit, and why.
    fn refused(&self, mode: ControlMode, ask: impl Fn(usize) -> Option<Ask>) -> Option<(usize, Refusal)> {
        self.limiters.iter().enumerate().find_map(|(j, limiter)| {
            let ask = ask(j)?;
            let refusal = match mode {
                ControlMode::Velocity => (!ask.value.is_finite()).then_some(Refusal::NonFinite),
                _ => limiter.refuses(ask.value, ask.new_hands),
            };
            Some((j, refusal?))
        })
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
        let still = self.state.velocity.iter().take(self.config.dof).all(|v| v.abs() <= TICK_STANDSTILL);
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

    /// Returns the cause of the latched hold for a refusal.
    pub fn cause_of(refusal: Refusal) -> Cause {
        match refusal {
            Refusal::NonFinite => Cause::NonFinite,
            Refusal::Jump(_) => Cause::Jump,
        }
    }
}

/// The joint with the largest value by amount, and the value.
fn furthest(values: impl Iterator<Item = f64>) -> Option<(u16, f64)> {
    values.zip(0u16..).map(|(v, j)| (j, v)).max_by(|a, b| a.1.abs().total_cmp(&b.1.abs()))
}
