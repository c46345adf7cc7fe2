//! An arm's own time: while its controller slows all motion (a speed slider, a safety function), setpoints are made
//! for the time that passes there. Their path and their limits stay the same; nothing runs ahead of the arm.

use super::ArmControl;
use crate::rest::braking;
use dimos_core::joint::ControlMode;

/// A smaller fraction of the speed is none: the controller has stopped the arm on its way.
const STANDSTILL: f64 = 1e-4;

/// Returns the fraction that counts of one that was reported, 0 to 1; 1 where none is.
pub fn effective(reported: Option<f64>) -> f64 {
    match reported {
        Some(fraction) if fraction < STANDSTILL => 0.0,
        Some(fraction) if fraction < 1.0 => fraction,
        _ => 1.0,
    }
}

impl ArmControl {
    /// Returns the fraction of its speed at which its controller runs motions, 0 to 1.
    pub fn speed_fraction(&self) -> f64 {
        effective(self.feedback.state().speed_fraction)
    }

    /// Returns the time that passes for its motion in a step of `dt` [s].
    pub fn own_time(&self, dt: f64) -> f64 {
        dt * self.speed_fraction()
    }

    /// Its controller has stopped it on its way, and no setpoint moves on. Velocities end meanwhile: when the
    /// controller continues, so do positions on their path; a stream of velocities begins again.
    pub(super) fn stays(&mut self, mode: ControlMode, dt: f64) {
        let decreases = braking::decreases(&self.limiters, dt);
        let joints = self.limiters.iter_mut().zip(decreases).zip(self.command.values.iter_mut());
        for ((limiter, decrease), out) in joints {
            if mode == ControlMode::Velocity {
                limiter.brake_in_place(decrease, dt);
                *out = limiter.velocity();
            } else {
                limiter.repeat(0.0);
                *out = limiter.position();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_a_fraction_counts_as_full_speed() {
        let of =
            [None, Some(1.0), Some(1.7), Some(f64::NAN), Some(0.3), Some(1e-5), Some(0.0), Some(-1.0)].map(effective);
        assert_eq!(of, [1.0, 1.0, 1.0, 1.0, 0.3, 0.0, 0.0, 0.0]);
    }
}
