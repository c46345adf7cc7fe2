//! Tracking supervision of one arm: compares what is measured with the setpoints that the arm may still be following,
//! and reports an arm that stays too far from them.

use std::time::Duration;

use super::coast::Coast;
use super::config::ArmConfig;
use super::limit::Limiter;
use super::setpoints::{Range, SetpointWindow};
use crate::arm::ArmState;
use crate::clock::Mono;
use crate::joint::{Joints, MAX_DOF};
use crate::telemetry::Cause;

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
    /// `supervision.lag` [s].
    lag: f64,
    /// `lag`, rounded to ns.
    window: Duration,
    /// `supervision.tracking_tolerance` [rad].
    tolerance: f64,
    /// `supervision.accuracy` [rad].
    accuracy: f64,
    setpoints: SetpointWindow,
    /// Distance of each joint from the range of its setpoints of the last `lag` seconds [rad]; 0 in velocity mode.
    errors: Joints,
    coast: Coast,
    /// How long the tolerance has been exceeded [s].
    exceeded: f64,
}

impl Tracking {
    /// Creates the supervision of an arm without setpoints so far, for ticks of this period.
    pub fn new(config: &ArmConfig, period: Duration) -> Self {
        let s = &config.supervision;
        let span = s.lag + s.stale_after.as_secs_f64() + 2.0 * period.as_secs_f64();
        Self {
            dof: config.dof,
            lag: s.lag,
            window: Duration::from_secs_f64(s.lag),
            tolerance: s.tracking_tolerance,
            accuracy: s.accuracy,
            setpoints: SetpointWindow::new(config.dof, span),
            errors: [0.0; MAX_DOF],
            coast: Coast::default(),
            exceeded: 0.0,
        }
    }

    /// Forgets all setpoints: new ones do not continue them.
    pub fn restart(&mut self) {
        self.setpoints.clear();
        self.exceeded = 0.0;
    }

    /// Adds the setpoints of a tick [rad or rad/s].
    pub fn push(&mut self, now: Mono, values: &Joints) {
        self.setpoints.push(now, values);
    }

    /// Returns the range of the setpoints that the arm may be following in this state.
    pub fn range(&self, state: &ArmState) -> Option<Range> {
        self.setpoints.range(state.stamp.before(self.window))
    }

    /// Returns the distance of a joint from the range of its setpoints [rad]; 0 inside, and in velocity mode.
    pub fn error(&self, joint: usize) -> f64 {
        self.errors.get(joint).copied().unwrap_or_default()
    }

    /// Sets all errors to 0: there are no position setpoints to compare with.
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
        let coasting = self.coast.is_possible(state.stamp);
        let joints = state.position.iter().zip(limiters).zip(&mut self.errors).enumerate();
        for (j, ((q, limiter), error)) in joints {
            if near((q, limiter)) {
                continue;
            }
            *error = if coasting { self.coast.error(j, *q, &range) } else { range.distance(j, *q) };
        }
    }

    /// A gap begins.
    pub fn begin_to_coast(&mut self, now: Mono, limiters: &[Limiter]) {
        self.coast.begin(now, limiters, self.lag);
    }

    /// Returns whether the arm may still be on its way back to the last setpoint before a gap.
    pub fn is_coasting(&mut self, now: Mono, state: &ArmState, limiters: &[Limiter]) -> bool {
        self.coast.goes_on(now, state, limiters, AT_SETPOINT + self.accuracy)
    }

    /// Returns the cause for a hold if the tolerance has been exceeded for too long. `velocity`: the arm is in velocity
    /// mode.
    pub fn supervise(&mut self, velocity: bool, state: &ArmState, dt: f64) -> Option<Cause> {
        let (joint, by) = if velocity {
            let range = self.range(state)?;
            furthest((0..self.dof).map(|j| velocity_error(&range, state, j)))?
        } else {
            furthest(self.errors.iter().copied().take(self.dof))?
        };
        let tolerance = if velocity { 0.0 } else { self.tolerance };
        self.exceeded = if by.abs() > tolerance { self.exceeded + dt } else { 0.0 };
        let limit = if velocity { MAX_TIME.1 } else { MAX_TIME.0 };
        (self.exceeded > limit).then_some(Cause::Tracking(joint, by))
    }

    /// Restarts the time for which the tolerance is exceeded: the arm is not supervised now.
    pub fn pause(&mut self) {
        self.exceeded = 0.0;
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
pub(super) fn furthest(values: impl Iterator<Item = f64>) -> Option<(u16, f64)> {
    values.zip(0u16..).map(|(v, j)| (j, v)).max_by(|a, b| a.1.abs().total_cmp(&b.1.abs()))
}

#[cfg(test)]
#[path = "tracking_tests.rs"]
mod tests;
