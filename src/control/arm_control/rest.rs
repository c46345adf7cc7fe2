//! How an arm stops: it decelerates by commands, settles at the last of them, and then gets a stop from its
//! own controller.

use super::ArmControl;
use crate::clock::Mono;
use crate::control::limit::Limiter;
use crate::joint::{ControlMode, TICK_STANDSTILL};
use crate::telemetry::Cause;

/// Maximum time for a lagging arm to settle at its last command before it is stopped [s].
const SETTLING_TIME: f64 = 0.5;
/// The setpoint of a held, stationary joint is drawn to the joint when it is further away than this plus the joint's
/// accuracy [rad].
const DRAW_TOLERANCE: f64 = 0.04;
/// Maximum time for that, within the joint's velocity limit [s].
const DRAW_TIME: f64 = 0.1;

/// State of an arm on its way to rest.
#[derive(Debug)]
pub(super) struct Rest {
    /// Whether the arm's controller must still be ordered to stop, once the arm is at rest.
    pub stop_pending: bool,
    was_held: bool,
    /// Time left to draw setpoints to the measured positions [s].
    drawing: f64,
    /// How long the commands have been at rest [s].
    settling: f64,
}

impl Default for Rest {
    fn default() -> Self {
        Self { stop_pending: false, was_held: false, drawing: DRAW_TIME, settling: 0.0 }
    }
}

impl Rest {
    /// Takes this tick's phase: a new hold needs a stop. `foreign`: another program controls the arm.
    pub fn enter(&mut self, held: bool, foreign: bool) {
        self.stop_pending |= held && !self.was_held && !foreign;
        self.was_held = held;
    }

    /// The arm starts to follow new commands.
    pub fn start(&mut self) {
        self.drawing = DRAW_TIME;
    }
}

impl ArmControl {
    /// Decelerates by commands; once at rest, orders a stop and commands nothing more.
    pub(super) fn come_to_rest(&mut self, now: Mono, dt: f64) {
        if let Some(mode) = self.command.mode {
            // Without a connection, an arm in velocity mode keeps its last velocity until it is stopped. After a short
            // gap the deceleration continues.
            let silent = now.since(self.written.last().at) > self.config.supervision.stale_after;
            let stuck = self.gap_since.is_some() && silent && mode == ControlMode::Velocity;
            let drawn = mode.is_position() && self.draw(dt);
            if drawn || !(stuck || self.settled(dt)) {
                return self.hold(mode, dt);
            }
            self.command.mode = None;
            self.rest.stop_pending = true;
        }
        if self.rest.stop_pending {
            self.stop();
        }
    }

    /// Draws the setpoints of stationary joints that are too far from them to where the joints are. Returns whether
    /// there are any.
    fn draw(&mut self, dt: f64) -> bool {
        let tolerance = DRAW_TOLERANCE + self.config.supervision.accuracy;
        let mut drawn = false;
        // A position that jumped may be wrong: no setpoint is made from it before a reset.
        if matches!(self.failsafe.cause(), Cause::PositionJump(..)) || self.feedback.is_rejected() {
            return false;
        }
        self.rest.drawing = (self.rest.drawing - dt).max(dt);
        let (state, fresh) = (self.feedback.state(), self.feedback.freshness().fresh);
        for (j, limiter) in self.limiters.iter_mut().enumerate().take(self.config.dof) {
            // The setpoint of a joint that still moves decelerates like any other.
            let stationary = state.velocity.get(j).is_none_or(|v| v.abs() <= TICK_STANDSTILL);
            let off = stationary && self.tracking.error(j).abs() > tolerance;
            if off && fresh && self.gap_since.is_none() {
                let q = state.position.get(j).copied().unwrap_or_default();
                let step = (q - limiter.position()).abs() * dt / self.rest.drawing;
                limiter.draw(q, step.min(limiter.bounds().velocity * dt));
                drawn = true;
            }
        }
        drawn
    }

    /// Orders a stop from the arm's controller.
    pub(super) fn stop(&mut self) {
        self.rest.stop_pending = false;
        self.rest.settling = 0.0;
        self.command.stop_seq = self.command.stop_seq.wrapping_add(1);
    }

    /// Returns whether the arm has reached its last command. If it were stopped before, it would hold short of that
    /// command, and move by the difference at its next start.
    fn settled(&mut self, dt: f64) -> bool {
        if !self.at_rest() {
            self.rest.settling = 0.0;
            return false;
        }
        self.rest.settling += dt;
        self.at_standstill() || !self.feedback.freshness().fresh || self.rest.settling > SETTLING_TIME
    }

    /// Returns whether the measured velocities and the commands are at rest.
    pub(super) fn at_standstill(&self) -> bool {
        let velocities = self.feedback.state().velocity.iter().take(self.config.dof);
        let still = velocities.into_iter().all(|v| v.abs() <= TICK_STANDSTILL);
        still && self.limiters.iter().all(Limiter::at_rest)
    }

    /// Commands the next step of the deceleration to rest, then the same values again.
    pub(super) fn hold(&mut self, mode: ControlMode, dt: f64) {
        let joints = self.limiters.iter_mut().zip(&self.feedback.state().position).zip(self.command.values.iter_mut());
        for ((limiter, q), out) in joints {
            *out = match mode {
                ControlMode::Velocity => limiter.hold_velocity(*q, dt),
                _ => limiter.hold_position(dt),
            };
        }
    }
}
