//! The speed override of a run: every motion runs at a fraction of its speed, or pauses on its path.
//!
//! Tasks that follow a path scale the time along it (see [`PathClock`](super::path_clock::PathClock)): the path stays
//! the same, and with it the proof that it is free. For streams the velocity limits are scaled.

use super::rate::{Rate, RateLimits};
use dimos_core::joint::LOWEST_SPEED;

/// How fast the velocity limits of streams change: all of them in about 0.6 s.
const CHANGE: RateLimits = RateLimits { first: 3.0, second: 20.0 };

/// The override.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpeedOverride {
    /// Fraction of the speed, [`LOWEST_SPEED`] to 1.
    pub fraction: f64,
    /// Whether all motions are paused.
    pub paused: bool,
    /// Fraction of the velocity limits of streams: follows.
    streams: Rate,
}

impl Default for SpeedOverride {
    fn default() -> Self {
        Self { fraction: 1.0, paused: false, streams: Rate::new(1.0) }
    }
}

impl SpeedOverride {
    /// Sets the fraction, at least [`LOWEST_SPEED`] and at most 1. What is not a number changes nothing.
    pub fn set(&mut self, fraction: f64) {
        if !fraction.is_nan() {
            self.fraction = fraction.clamp(LOWEST_SPEED, 1.0);
        }
    }

    /// Returns the rate that motions are to have: 0 while paused.
    pub fn target(&self) -> f64 {
        if self.paused { 0.0 } else { self.fraction }
    }

    /// Returns the fraction of the velocity limits that streams have at present.
    pub fn of_streams(&self) -> f64 {
        self.streams.value()
    }

    /// Advances by a step of `dt` [s].
    pub fn advance(&mut self, dt: f64) {
        self.streams.approach(self.target(), CHANGE, dt);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_limits_of_streams_follow_smoothly() {
        let mut speed = SpeedOverride { paused: true, ..SpeedOverride::default() };
        let (mut before, mut ticks) = (1.0, 0);
        while speed.of_streams() > 0.0 {
            speed.advance(0.01);
            assert!((before - speed.of_streams()) / 0.01 <= CHANGE.first + 1e-9);
            (before, ticks) = (speed.of_streams(), ticks + 1);
        }
        assert!((40..100).contains(&ticks), "{ticks} ticks of 10 ms");
        (speed.paused, speed.fraction) = (false, 0.3);
        (0..100).for_each(|_| speed.advance(0.01));
        assert_eq!(speed.of_streams(), 0.3);
    }

    #[test]
    fn a_fraction_is_kept_within_its_range() {
        let mut speed = SpeedOverride::default();
        for (asked, set) in [(0.3, 0.3), (f64::NAN, 0.3), (7.0, 1.0), (-1.0, LOWEST_SPEED), (f64::INFINITY, 1.0)] {
            speed.set(asked);
            assert_eq!(speed.fraction, set, "{asked}");
        }
    }
}
