//! How an arm gets over a gap in its setpoints: at speed it stops on its own beyond the last setpoint, and returns to
//! it. Neither is a tracking error. New setpoints wait until it is back: they restart from rest at the last one, and
//! would pass an arm that still moves the other way.

use std::time::Duration;

use super::limit::Limiter;
use super::setpoints::Range;
use crate::arm::ArmState;
use crate::clock::Mono;
use crate::joint::{Joints, MAX_DOF, TICK_STANDSTILL};

/// Maximum time until the arm is back, as a multiple of its braking time: it brakes, and accelerates and brakes on its
/// way back, 1 + 2/√2 with the acceleration of its limits.
const TIME: f64 = 2.5;

/// The way of an arm beyond its last setpoint and back.
#[derive(Debug)]
pub struct Coast {
    /// How far each joint coasts beyond the last setpoint [rad], signed.
    distance: Joints,
    /// When the gap was noticed, and how long the arm may take.
    from: Mono,
    until: Mono,
}

impl Default for Coast {
    fn default() -> Self {
        Self { distance: [0.0; MAX_DOF], from: Mono::ZERO, until: Mono::ZERO }
    }
}

impl Coast {
    /// A gap begins: the limiters have the velocities that the joints had. `lag`: how far the arm is behind its
    /// setpoints [s].
    pub fn begin(&mut self, now: Mono, limiters: &[Limiter], lag: f64) {
        let mut longest = 0.0f64;
        for (distance, limiter) in self.distance.iter_mut().zip(limiters) {
            let (v, a) = (limiter.velocity(), limiter.bounds().acceleration);
            *distance = v * v.abs() / (2.0 * a);
            longest = longest.max(v.abs() / a);
        }
        let time = (TIME * longest + 2.0 * lag).clamp(0.0, 60.0);
        (self.from, self.until) = (now, now.after(Duration::from_secs_f64(time)));
    }

    /// Returns whether the arm may still be on its way.
    pub fn is_possible(&self, at: Mono) -> bool {
        at < self.until
    }

    /// Ends it if a state from after the gap shows every joint at rest, at most `tolerance` [rad] from its setpoint.
    /// Returns whether the arm may still be on its way.
    pub fn goes_on(&mut self, now: Mono, state: &ArmState, limiters: &[Limiter], tolerance: f64) -> bool {
        let here = |(q, limiter): (&f64, &Limiter)| (q - limiter.position()).abs() <= tolerance;
        let there = state.position.iter().zip(limiters).all(here);
        let still = state.velocity.iter().take(limiters.len()).all(|v| v.abs() <= TICK_STANDSTILL);
        if there && still && state.stamp >= self.from {
            self.until = Mono::ZERO;
        }
        self.is_possible(now)
    }

    /// Returns how far a joint at `q` is from its setpoints and from its way beyond them [rad].
    pub fn error(&self, joint: usize, q: f64, range: &Range) -> f64 {
        let coast = self.distance.get(joint).copied().unwrap_or_default();
        let distance = range.distance(joint, q);
        if coast * distance > 0.0 { distance - distance.max(-coast.abs()).min(coast.abs()) } else { distance }
    }
}
