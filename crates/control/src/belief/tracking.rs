//! Tracking supervision of one arm: compares what is measured with the setpoints that the arm may still be following,
//! and reports an arm that stays too far from them.

use std::time::Duration;

use super::setpoints::{Range, SetpointWindow};
use crate::config::ArmConfig;
use crate::limit::Limiter;
use dimos_core::arm::ArmState;
use dimos_core::clock::Mono;
use dimos_core::joint::{Joints, MAX_DOF};
use dimos_core::telemetry::Cause;

/// How long the tracking error may exceed its tolerance before the arm is held [s]: positions, velocities.
const MAX_TIME: (f64, f64) = (0.1, 0.2);
/// Tolerance of the measured velocity in velocity mode: absolute [rad/s], and relative to the velocity.
const VELOCITY_TOLERANCE: (f64, f64) = (0.2, 0.2);
/// A joint this close to its newest setpoint has no tracking error [rad].
const AT_SETPOINT: f64 = 0.01;

/// Tracking supervision of one arm.
#[derive(Debug)]
pub struct Tracking {
    dof: usize,
    /// `supervision.lag`, rounded to ns.
    window: Duration,
    /// `supervision.tracking_tolerance` [rad].
    tolerance: f64,
    /// Positions: those that were commanded, in velocity mode those that the commanded velocities lead to [rad].
    positions: SetpointWindow,
    /// Commanded velocities in velocity mode [rad/s].
    velocities: SetpointWindow,
    /// Distance of each joint from the range of its setpoints of the last `lag` seconds [rad].
    errors: Joints,
    /// Time that did not pass for the arm, because its controller slowed it [ns], and until when that is counted.
    behind: (u64, Mono),
    /// How long the tolerances have been exceeded [s]: of positions, of velocities.
    exceeded: (f64, f64),
}

impl Tracking {
    /// Creates the supervision of an arm without setpoints so far, for ticks of this period.
    pub fn new(config: &ArmConfig, period: Duration) -> Self {
        let s = &config.supervision;
        let span = s.lag + s.stale_after.as_secs_f64() + 2.0 * period.as_secs_f64();
        Self {
            dof: config.dof,
            window: Duration::from_secs_f64(s.lag),
            tolerance: s.tracking_tolerance,
            positions: SetpointWindow::new(config.dof, span),
            velocities: SetpointWindow::new(config.dof, span),
            errors: [0.0; MAX_DOF],
            behind: (0, Mono::ZERO),
            exceeded: (0.0, 0.0),
        }
    }

    /// Forgets all setpoints: new ones do not continue them.
    pub fn restart(&mut self) {
        self.positions.clear();
        self.velocities.clear();
        self.exceeded = (0.0, 0.0);
    }

    /// Notes the fraction of its speed at which the arm's controller runs its motion until `now`: an arm that is slowed
    /// follows setpoints so much later.
    pub fn pass(&mut self, now: Mono, speed: f64) {
        let (behind, since) = self.behind;
        let lost =
            if speed < 1.0 && since != Mono::ZERO { now.since(since).mul_f64(1.0 - speed) } else { Duration::ZERO };
        self.behind = (behind + lost.as_nanos() as u64, now);
    }

    /// Returns a time on the arm's own clock.
    fn own(&self, at: Mono) -> Mono {
        at.before(Duration::from_nanos(self.behind.0))
    }

    /// Adds the setpoints of a tick [rad]; in velocity mode also their velocities [rad/s].
    pub fn push(&mut self, now: Mono, positions: &Joints, velocities: Option<&Joints>) {
        let now = self.own(now);
        self.positions.push(now, positions);
        if let Some(velocities) = velocities {
            self.velocities.push(now, velocities);
        }
    }

    /// Returns the range of the positions that the arm may be following in this state.
    pub fn range(&self, state: &ArmState) -> Option<Range> {
        self.positions.range(self.own(state.stamp).before(self.window))
    }

    /// Returns the range of the velocities that it may be following; `None` if none were commanded.
    pub fn velocity_range(&self, state: &ArmState) -> Option<Range> {
        self.velocities.range(self.own(state.stamp).before(self.window))
    }

    /// Returns the distance of a joint from the range of its setpoints [rad]; 0 inside.
    pub fn error(&self, joint: usize) -> f64 {
        self.errors.get(joint).copied().unwrap_or_default()
    }

    /// Sets all errors to 0: there are no setpoints to compare with.
    pub fn clear_errors(&mut self) {
        self.errors = [0.0; MAX_DOF];
    }

    /// Compares measured positions with their setpoints.
    pub fn compare(&mut self, state: &ArmState, limiters: &[Limiter]) {
        self.clear_errors();
        // The newest setpoint is always in range.
        let near = |(q, limiter): (&f64, &Limiter)| (q - limiter.position()).abs() <= AT_SETPOINT;
        if state.position.iter().zip(limiters).all(near) {
            return;
        }
        let Some(range) = self.range(state) else { return };
        for (j, ((q, limiter), error)) in state.position.iter().zip(limiters).zip(&mut self.errors).enumerate() {
            if !near((q, limiter)) {
                *error = range.distance(j, *q);
            }
        }
    }

    /// Returns the cause for a hold if a tolerance has been exceeded for too long.
    pub fn supervise(&mut self, state: &ArmState, dt: f64) -> Option<Cause> {
        let (joint, by) = furthest(self.errors.iter().copied().take(self.dof))?;
        self.exceeded.0 = if by.abs() > self.tolerance { self.exceeded.0 + dt } else { 0.0 };
        if self.exceeded.0 > MAX_TIME.0 {
            return Some(Cause::Tracking(joint, by));
        }
        let range = self.velocity_range(state)?;
        let (joint, by) = furthest((0..self.dof).map(|j| velocity_error(&range, state, j)))?;
        self.exceeded.1 = if by.abs() > 0.0 { self.exceeded.1 + dt } else { 0.0 };
        (self.exceeded.1 > MAX_TIME.1).then_some(Cause::Tracking(joint, by))
    }

    /// Restarts the time for which the tolerance is exceeded: the arm is not supervised now.
    pub fn pause(&mut self) {
        self.exceeded = (0.0, 0.0);
    }
}

/// Returns how far a joint's velocity is from its setpoints, if that exceeds the tolerance [rad/s]; otherwise 0.
fn velocity_error(range: &Range, state: &ArmState, joint: usize) -> f64 {
    let Some(v) = state.velocity.get(joint) else { return 0.0 };
    let tolerance = VELOCITY_TOLERANCE.0.max(VELOCITY_TOLERANCE.1 * v.abs());
    let distance = range.distance(joint, *v);
    if distance.abs() > tolerance { distance } else { 0.0 }
}

/// Returns the joint with the largest absolute value, and that value.
pub fn furthest(values: impl Iterator<Item = f64>) -> Option<(u16, f64)> {
    values.zip(0u16..).map(|(v, j)| (j, v)).max_by(|a, b| a.1.abs().total_cmp(&b.1.abs()))
}

#[cfg(test)]
#[path = "tracking_tests.rs"]
mod tests;
