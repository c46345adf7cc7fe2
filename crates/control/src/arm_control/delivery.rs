//! Starts, and delivery of commands: a start takes its pose from an arm at rest; after a gap in delivery, motion
//! continues from the last written setpoint, or from where the arm's controller has stopped.

use super::ArmControl;
use crate::belief::setpoints::Range;
use crate::rest::start_pose::{self, AGREEMENT, Since};
use crate::rest::written::Issued;
use crate::rest::{Gap, Start, braking};
use dimos_core::arm::{AfterGap, ArmState, Link};
use dimos_core::clock::Mono;
use dimos_core::joint::{ControlMode, Joints, MAX_DOF};
use dimos_core::telemetry::{Cause, Phase};

/// A slowed arm is waited for after a gap as if it had this fraction of its speed, or more.
const SLOWEST: f64 = 0.05;
/// A joint this close to where it is to rest is there, beside its accuracy and droop [rad].
const NEAR: f64 = 0.01;

impl ArmControl {
    /// Returns the time of the last written command during a gap.
    pub fn gap(&self) -> Option<Mono> {
        self.rest.gap.map(|gap| gap.last)
    }

    /// Returns the time of the last written command before a gap that has just ended: motions continue from there.
    pub fn resumed(&self) -> Option<Mono> {
        self.resumed
    }

    /// Takes what the device thread has written.
    pub(super) fn take_written(&mut self) {
        let state = self.feedback.state();
        self.rest.written.report(state.written);
        // Without power or a connection, anything may move the arm.
        let lost = !state.enabled || matches!(state.link, Link::Down | Link::Faulted);
        if lost && state.seq != 0 {
            self.rest.forget_written();
            self.command.rest = self.command.rest.filter(|_| state.enabled);
        }
    }

    /// Begins a new start in this mode: the next command does not continue the previous ones.
    pub(super) fn start(&mut self, mode: ControlMode, now: Mono) {
        if !matches!(self.rest.start, Start::Taking(..)) {
            self.rest.start = Start::Taking(now, mode);
            self.too_fast_since = None;
        }
    }

    /// Takes the pose of a start as soon as the arm is known to be at rest, and checks that it is written.
    pub(super) fn take_start_pose(&mut self, now: Mono) {
        match self.rest.start {
            Start::None => {}
            Start::Writing(first) if self.feedback.state().written >= first => {
                self.rest.start = Start::None;
                (self.rest.holds_written, self.rest.acknowledged) = (true, false);
            }
            // The last check before the wire has refused it: what it was taken from is no longer so.
            Start::Writing(_) if now.since(self.started_at) > AGREEMENT * 4 => {
                let mode = self.command.mode.or_else(|| self.config.position_mode()).unwrap_or_default();
                self.rest.start = Start::Taking(self.started_at, mode);
                self.command.mode = None;
            }
            Start::Writing(_) => {}
            Start::Taking(since, mode) => {
                let rests = self.feedback.is_usable() && self.feedback.rest_time() >= AGREEMENT;
                if !rests {
                    if now.since(since) > start_pose::LIMIT {
                        let (joint, by) = self.furthest_from_enabling();
                        self.failsafe.hold(Cause::MovedWhileActivating(joint, by), now);
                    }
                    return;
                }
                let since = Since {
                    // Hands and gravity have moved a compliant one.
                    written: self.rest.last_written().filter(|last| last.mode != ControlMode::Impedance),
                    inexact: if self.rest.by_velocity { super::MAX_CORRECTION } else { 0.0 },
                    acknowledged: self.rest.acknowledged,
                    outside: self.rest.outside,
                };
                let supervision = &self.config.supervision;
                let is_turn = |joint, by| self.feedback.is_turn(joint, by);
                match start_pose::positions(self.feedback.state(), &self.limiters, supervision, since, is_turn) {
                    Err(cause) => self.failsafe.hold(cause, now),
                    Ok(positions) => {
                        for (limiter, q) in self.limiters.iter_mut().zip(positions) {
                            limiter.seed(q);
                        }
                        self.command.start_seq = self.command.start_seq.wrapping_add(1);
                        (self.command.mode, self.command.unheard) = (Some(mode), None);
                        (self.rest.start, self.started_at) = (Start::Writing(self.command.seq + 1), now);
                        self.enabled_at = self.feedback.state().position;
                        self.tracking.restart();
                    }
                }
            }
        }
    }

    /// Returns whether a start is under way.
    pub(super) fn is_starting(&self) -> bool {
        self.rest.start != Start::None
    }

    /// Finds out whether commands reach the arm, and after a gap, whether it is at rest where its motion can
    /// continue. During a gap, the limiters are at the last written setpoint.
    pub(super) fn check_gap(&mut self, now: Mono) {
        self.resumed = None;
        let Some(mode) = self.command.mode.or(self.rest.gap.map(|gap| gap.mode)) else { return };
        if self.is_starting()
            || !matches!(self.failsafe.phase(), Phase::Ready | Phase::Activating | Phase::Held | Phase::Standby)
        {
            self.rest.gap = None;
            return;
        }
        let down = matches!(self.feedback.state().link, Link::Down | Link::Faulted);
        let waits = self.config.supervision.after_gap != AfterGap::RestsAtSetpoint && mode.is_position();
        let last = *self.rest.written.last();
        // A command from before the gap may be written after the gap was noticed.
        let late = self.rest.gap.is_some_and(|gap| last.seq < gap.first) && !waits;
        if late || (self.rest.gap.is_none() && self.rest.written.gap(now)) {
            if self.rest.gap.is_none() {
                let longest = braking::time(&self.limiters) / self.speed_fraction().max(SLOWEST);
                let first = self.command.seq + 1;
                self.rest.begin_gap(now, first, mode, longest, self.config.supervision.lag);
            }
            if self.feedback.state().refused > last.seq {
                self.failsafe.hold(Cause::SetpointRefused, now);
            }
            for (limiter, (q, v)) in self.limiters.iter_mut().zip(last.position.iter().zip(&last.velocity)) {
                // In position mode the joints are to rest at the last setpoint; in velocity mode they continue.
                limiter.rewind(*q, if mode.is_position() { 0.0 } else { *v });
            }
            self.efforts.iter_mut().for_each(|efforts| efforts.rewind(last.effort.as_ref()));
            self.tracking.pause();
            return;
        }
        let Some(gap) = self.rest.gap else { return };
        if !mode.is_position() {
            self.rest.gap = None;
            return;
        }
        self.tracking.pause();
        self.end_gap(gap, waits, down, now);
    }

    /// Ends a gap once the arm is at rest, or is not in time.
    fn end_gap(&mut self, gap: Gap, waits: bool, down: bool, now: Mono) {
        let rested = self.feedback.is_usable()
            && self.feedback.rest_time() >= AGREEMENT
            && self.feedback.state().stamp.since(gap.noticed) >= AGREEMENT;
        let supervision = &self.config.supervision;
        let tolerance = NEAR + supervision.accuracy + supervision.droop;
        let off = self.limiters.iter().zip(&self.feedback.state().position).map(|(l, q)| q - l.position());
        let (joint, by) = crate::belief::tracking::furthest(off).unwrap_or_default();
        if rested && !down && waits {
            // Its controller has decelerated along the motion: where it rests, the next command begins.
            self.rest.gap = None;
            (self.resumed, self.rest.acknowledged) = (Some(gap.last), true);
            self.start(gap.mode, now);
            self.take_start_pose(now);
        } else if rested && !down && by.abs() <= tolerance {
            self.rest.gap = None;
            self.resumed = Some(gap.last);
            self.tracking.restart();
        } else if now >= gap.until && self.failsafe.phase() == Phase::Ready {
            self.failsafe.hold(Cause::Gap(joint, by, now.seconds_since(gap.last)), now);
        }
    }

    /// Completes the command that leaves the tick, and keeps it to know later what was written. `report` gets the joint
    /// and the effort whenever a limit begins to change one.
    pub fn issue(&mut self, now: Mono, dt: f64, report: impl FnMut(usize, f64)) {
        let Some(mode) = self.command.mode else { return };
        let mut issued = Issued { seq: self.command.seq, at: now, mode, ..Issued::default() };
        let out = issued.position.iter_mut().zip(&mut issued.velocity);
        for (((q, v), limiter), pace) in out.zip(&self.limiters).zip(&mut self.pace) {
            (*q, *v, *pace) = (limiter.position(), limiter.velocity(), limiter.covered() / dt);
        }
        self.rest.by_velocity = !mode.is_position();
        let speed = self.speed_fraction();
        self.command.velocity = std::array::from_fn(|j| self.commanded_velocity(j));
        self.command.acceleration = self.commanded_acceleration(speed);
        self.add_efforts(mode, now, dt, report);
        issued.effort = self.command.effort;
        self.rest.written.issue(issued);
        self.command.rest = Some(braking::rest_point(&self.limiters, dt));
        if self.rest.gap.is_none() {
            let velocities = (!mode.is_position()).then(|| self.command.values.map(|v| v * speed));
            self.tracking.pass(now, speed);
            self.tracking.push(now, &issued.position, velocities.as_ref());
        }
    }

    /// Returns the accelerations of the last command [rad/s²], in the time that passes here.
    fn commanded_acceleration(&self, speed: f64) -> Joints {
        let mut accelerations = [0.0; MAX_DOF];
        for ((out, limiter), before) in accelerations.iter_mut().zip(&self.limiters).zip(&self.before) {
            let covered = limiter.covered();
            *out = if covered > 0.0 { (limiter.velocity() - before.velocity()) / covered * speed * speed } else { 0.0 };
        }
        accelerations
    }

    /// The arm is no longer commanded while setpoints do not reach it: it rests at the last one that did.
    pub(super) fn rest_where_written(&mut self) {
        if self.rest.holds_written && !self.rest.by_velocity {
            self.command.rest = Some(*self.rest.last_position());
        }
    }

    /// The arm is not heard: it may have followed any of the setpoints since its last state.
    fn note_unheard(&mut self) {
        let Some(range) = self.tracking.range(self.feedback.state()) else { return };
        let [low, high] = self.command.unheard.get_or_insert([range.low, range.high]);
        for (bound, value) in low.iter_mut().zip(range.low) {
            *bound = bound.min(value);
        }
        for (bound, value) in high.iter_mut().zip(range.high) {
            *bound = bound.max(value);
        }
    }

    /// The arm is heard again. If it has followed the setpoints, nothing was lost. Otherwise it is stopped where it is
    /// within them, and that counts as written; where what is read is nowhere near them, it keeps its point of rest.
    pub(super) fn hear_again(&mut self) {
        let commanded = self.command.mode.is_some_and(ControlMode::is_position);
        if !self.feedback.is_heard() && commanded && !self.is_starting() {
            self.note_unheard();
        }
        if self.command.unheard.is_none() || !self.feedback.is_usable() {
            return;
        }
        let state = *self.feedback.state();
        if self.failsafe.phase() != Phase::Held {
            self.command.unheard = None;
        } else if self.command.mode.is_some() {
            let s = &self.config.supervision;
            let most = NEAR + s.accuracy + s.droop;
            let range = self.tracking.range(&state);
            let off = |range: Range| (0..self.config.dof).any(|j| self.distance(&range, &state, j) > most);
            if range.is_some_and(off) {
                (self.command.mode, self.rest.stop_pending) = (None, true);
            } else {
                self.command.unheard = None;
            }
        } else if self.feedback.rest_time() >= AGREEMENT {
            let (dof, supervision) = (self.config.dof, &self.config.supervision);
            if let Some(rest) = self.command.rest_within_unheard(&state.position, dof, supervision) {
                for (limiter, q) in self.limiters.iter_mut().zip(rest) {
                    limiter.rewind(q, 0.0);
                }
                self.rest.written.rests_at(&rest);
                self.command.rest = Some(rest);
            }
            self.command.unheard = None;
        }
    }

    fn distance(&self, range: &Range, state: &ArmState, joint: usize) -> f64 {
        range.distance(joint, state.position.get(joint).copied().unwrap_or_default()).abs()
    }
}
