//! Decides whether joint positions are reliable enough to enable the motors: stable for a while, confirmed by the
//! device if it can, and not all zero, which is what many controllers report before they have read their encoders.

use std::time::Duration;

use crate::adapter::JointReading;
use dimos_core::arm::{ArmState, Supervision};
use dimos_core::clock::Mono;

/// How long positions must have been stable.
const STABLE_FOR: Duration = Duration::from_millis(100);
/// Consecutive readings that must agree.
const READINGS: u32 = 3;
/// Measurement noise [rad].
const NOISE: f64 = 0.02;
/// Tolerated apparent speed, as a factor of the velocity limit.
const SPEED_MARGIN: f64 = 1.5;

/// Why positions are not plausible.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum Doubt {
    /// Too few readings, or jumps between them.
    #[default]
    Unstable,
    /// The device reports that it has not measured yet.
    NotMeasured,
    /// Every joint is at exactly zero, and the device cannot confirm that.
    Zero,
}

/// Monitors the readings of an arm that is to be enabled.
#[derive(Debug, Default)]
pub struct Plausible {
    since: Option<Mono>,
    readings: u32,
    doubt: Doubt,
}

impl Plausible {
    /// Discards earlier readings: a reading failed, or the connection is new.
    pub fn reset(&mut self) {
        *self = Self::default();
    }

    /// Adds a reading; `before` is the previous state. `speed` is the velocity limit of the fastest joint [rad/s].
    pub fn take(&mut self, reading: &JointReading, stamp: Mono, before: &ArmState, speed: f64, config: &Supervision) {
        let dof = before.dof;
        let zero = reading.position.iter().take(dof).all(|q| *q == 0.0);
        let doubt = match reading.valid {
            Some(false) => Some(Doubt::NotMeasured),
            None if zero && !config.accept_zero_pose => Some(Doubt::Zero),
            _ => None,
        };
        let reach = SPEED_MARGIN * speed * stamp.seconds_since(before.stamp).clamp(0.0, 0.1) + NOISE;
        let mut moved = reading.position.iter().zip(&before.position).take(dof);
        let agrees = before.seq != 0 && moved.all(|(new, old)| (new - old).abs() <= reach);
        match doubt {
            Some(doubt) => *self = Self { since: None, readings: 0, doubt },
            None if agrees && self.since.is_some() => self.readings += 1,
            None => *self = Self { since: Some(stamp), readings: 1, doubt: Doubt::Unstable },
        }
    }

    /// Returns whether positions have been stable for long enough at `stamp`.
    pub fn stable(&self, stamp: Mono) -> bool {
        self.readings >= READINGS && self.since.is_some_and(|since| stamp.since(since) >= STABLE_FOR)
    }

    /// Returns why the arm was not enabled, with a hint.
    pub fn objection(&self, hardware_id: &str) -> String {
        match self.doubt {
            Doubt::Unstable => {
                "joint positions are missing or inconsistent: not enabled without a plausible pose".to_owned()
            }
            Doubt::NotMeasured => "the arm reports that its joint positions are not measured yet".to_owned(),
            Doubt::Zero => format!(
                "every joint reads exactly 0, which most controllers report before they have measured\nhint: if the arm truly \
                 is at zero: --set hardware.{hardware_id}.accept_zero_pose=true"
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_core::joint::joints_of;

    /// Feeds readings 10 ms apart; returns how many it takes until positions are stable.
    fn readings_until_stable(of: impl Fn(u64) -> (f64, Option<bool>), config: &Supervision) -> Option<u64> {
        let (mut plausible, mut state) = (Plausible::default(), ArmState { dof: 2, ..ArmState::default() });
        (1..100).find(|&k| {
            let (q, valid) = of(k);
            let stamp = Mono(k * 10_000_000);
            let reading = JointReading { position: joints_of(&[q, q]), valid, ..JointReading::default() };
            plausible.take(&reading, stamp, &state, 2.0, config);
            (state.seq, state.stamp, state.position) = (k, stamp, reading.position);
            plausible.stable(stamp)
        })
    }

    #[test]
    fn a_pose_is_stable_for_a_tenth_of_a_second() {
        let config = Supervision::default();
        assert_eq!(readings_until_stable(|_| (0.4, None), &config), Some(11));
        assert_eq!(readings_until_stable(|k| (if k < 8 { 0.0 } else { 0.4 }, None), &config), Some(18));
        assert_eq!(readings_until_stable(|k| (if k % 9 == 0 { 1.0 } else { 0.4 }, None), &config), None);
    }

    #[test]
    fn zero_everywhere_is_missing_until_it_is_confirmed() {
        let config = Supervision::default();
        assert_eq!(readings_until_stable(|_| (0.0, None), &config), None);
        assert_eq!(readings_until_stable(|_| (0.0, Some(true)), &config), Some(11));
        assert_eq!(readings_until_stable(|_| (0.4, Some(false)), &config), None);
        let accepted = Supervision { accept_zero_pose: true, ..config };
        assert_eq!(readings_until_stable(|_| (0.0, None), &accepted), Some(11));
    }
}
