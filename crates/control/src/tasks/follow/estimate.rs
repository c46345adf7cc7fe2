//! Position and velocity of a leader's joint, estimated from its samples: they are noisy, and may come less often than
//! the tick. A critically damped g-h filter, which follows a constant velocity without a lag.

use dimos_core::clock::Mono;

/// Bandwidth [rad/s].
const BANDWIDTH: f64 = 45.0;
/// A sample is extrapolated for at most this long [s].
const MAX_AHEAD: f64 = 0.05;

/// The estimate of one joint, in the positions of the joint that follows.
#[derive(Debug, Clone, Copy, Default)]
pub struct Estimate {
    position: f64,
    velocity: f64,
    /// The newest sample [rad], and when it was measured.
    sample: f64,
    stamp: Mono,
}

impl Estimate {
    /// Starts at rest at a sample.
    pub fn start(&mut self, sample: f64, stamp: Mono) {
        *self = Self { position: sample, velocity: 0.0, sample, stamp };
    }

    /// Returns the newest sample [rad].
    pub fn sample(&self) -> f64 {
        self.sample
    }

    /// Takes a sample [rad], unless it is the last one. Returns how far it is from that, and the time between them [s].
    pub fn take(&mut self, sample: f64, stamp: Mono) -> (f64, f64) {
        let dt = stamp.seconds_since(self.stamp);
        let step = sample - self.sample;
        if stamp <= self.stamp {
            return (0.0, 0.0);
        }
        // Both poles of the filter, for this time between two samples.
        let pole = 1.0 / (1.0 + BANDWIDTH * dt);
        let predicted = self.position + self.velocity * dt;
        let residual = sample - predicted;
        self.position = predicted + (1.0 - pole * pole) * residual;
        self.velocity += (1.0 - pole) * (1.0 - pole) / dt * residual;
        (self.sample, self.stamp) = (sample, stamp);
        (step, dt)
    }

    /// Returns position [rad] and velocity [rad/s] now.
    pub fn at(&self, now: Mono) -> (f64, f64) {
        let age = now.seconds_since(self.stamp);
        let position = self.position + self.velocity * age.min(MAX_AHEAD);
        (position, if age > MAX_AHEAD { 0.0 } else { self.velocity })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Feeds samples of a motion, one each `every` ms and 2 ms old, for 2 s.
    fn fed(every: u64, motion: impl Fn(f64) -> f64) -> (Estimate, Mono) {
        let at = |ms: u64| Mono(1_000_000_000 + ms * 1_000_000);
        let mut estimate = Estimate::default();
        estimate.start(motion(0.0), at(0));
        for ms in (every..2000).step_by(every as usize) {
            estimate.take(motion(ms as f64 * 1e-3), at(ms));
            estimate.take(f64::NAN, at(ms));
        }
        (estimate, at(2000))
    }

    #[test]
    fn a_constant_velocity_is_followed_without_a_lag_at_any_rate_of_samples() {
        for every in [1, 10, 20, 40] {
            let (estimate, now) = fed(every, |t| 0.1 + 0.5 * t);
            let (position, velocity) = estimate.at(now);
            assert!((position - 1.1).abs() < 1e-3 && (velocity - 0.5).abs() < 1e-3, "{every}: {position} {velocity}");
        }
    }

    #[test]
    fn the_resolution_of_a_hobby_servo_is_smoothed() {
        let step = std::f64::consts::TAU / 4096.0;
        let (estimate, now) = fed(10, |t| ((0.3 * t) / step).round() * step);
        let (position, velocity) = estimate.at(now);
        assert!((position - 0.6).abs() < step && (velocity - 0.3).abs() < 0.03, "{position} {velocity}");
    }

    #[test]
    fn a_sample_is_not_extrapolated_for_long() {
        let (estimate, now) = fed(10, |t| t);
        let (position, velocity) = estimate.at(now.after(std::time::Duration::from_secs(5)));
        assert!((position - 2.04).abs() < 2e-3 && velocity == 0.0, "{position} {velocity}");
    }
}
