//! Time along a path. It runs at rate 1, or slower with a speed override; it slows down for a cancel, and after a gap
//! restarts from rest at the arm's point of the path. The path stays the same: only the time along it is scaled, within
//! acceleration and jerk limits.

use super::rate::{Rate, RateLimits};
use dimos_core::clock::Mono;

/// Number of ticks whose time along the path is kept.
const KEPT: usize = 64;
/// Time along a path.
#[derive(Debug, Clone)]
pub struct PathClock {
    /// Time along the path [s].
    elapsed: f64,
    /// Time along the path per second.
    rate: Rate,
    kept: [(Mono, f64); KEPT],
    next: usize,
}

impl Default for PathClock {
    fn default() -> Self {
        Self { elapsed: 0.0, rate: Rate::new(1.0), kept: [(Mono::ZERO, 0.0); KEPT], next: 0 }
    }
}

impl PathClock {
    /// Returns the time along the path [s].
    pub fn elapsed(&self) -> f64 {
        self.elapsed
    }

    /// Returns the time along the path per second.
    pub fn rate(&self) -> f64 {
        self.rate.value()
    }

    /// Returns whether it runs at this rate.
    pub fn runs_at(&self, rate: f64) -> bool {
        self.rate() == rate
    }

    /// Starts a path, at this rate at once: every path starts from rest.
    pub fn start(&mut self, rate: f64) {
        *self = Self { rate: Rate::new(rate), ..Self::default() };
    }

    /// Keeps the point of the path that the tick of `now` commands.
    pub fn mark(&mut self, now: Mono) {
        if let Some(slot) = self.kept.get_mut(self.next) {
            *slot = (now, self.elapsed);
        }
        self.next = (self.next + 1) % KEPT;
    }

    /// Returns the time along the path that the tick of `at` commanded [s]; the present one if that is not known.
    pub fn at_tick(&self, at: Mono) -> f64 {
        let known = self.kept.iter().find(|(when, _)| *when == at && at != Mono::ZERO);
        known.map_or(self.elapsed, |(_, elapsed)| *elapsed)
    }

    /// Goes to a point of the path [s], at rest.
    pub fn rest_at(&mut self, elapsed: f64) {
        (self.elapsed, self.rate) = (elapsed, Rate::new(0.0));
    }

    /// Limits the rate at once.
    pub fn limit(&mut self, most: f64) {
        if self.rate() > most {
            self.rate = Rate::new(most);
        }
    }

    /// Goes to the point that the tick of `at` commanded, at rest; the tick of `now` commands the same.
    pub fn rewind(&mut self, at: Mono, now: Mono) {
        self.rest_at(self.at_tick(at));
        if let Some(mark) = self.kept.iter_mut().find(|(when, _)| *when == now) {
            mark.1 = self.elapsed;
        }
    }

    /// Advances by a step of `dt` [s].
    pub fn advance(&mut self, dt: f64) {
        self.elapsed += dt * self.rate();
    }

    /// Reduces the rate by `by`.
    pub fn slow_down(&mut self, by: f64) {
        self.rate = Rate::new(self.rate() - by);
    }

    /// Changes the rate towards `target` over a step of `dt` [s].
    pub fn approach(&mut self, target: f64, limits: RateLimits, dt: f64) {
        self.rate.approach(target, limits, dt);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn after_a_gap_it_continues_from_the_last_written_point() {
        let mut clock = PathClock::default();
        for k in 0..100u64 {
            clock.mark(Mono(10 * k + 10));
            clock.advance(0.01);
        }
        clock.rewind(Mono(10 * 96 + 10), Mono(1000));
        assert!((clock.elapsed() - 0.96).abs() < 1e-9 && clock.rate() == 0.0);
        clock.rewind(Mono(3), Mono(1000));
        assert!((clock.elapsed() - 0.96).abs() < 1e-9, "a tick that is not known leaves it");
        clock.rewind(Mono(1000), Mono(1000));
        assert!((clock.elapsed() - 0.96).abs() < 1e-9, "the tick of the gap commanded the same");
        clock.rewind(Mono(10 * 98 + 10), Mono(1010));
        assert!((clock.elapsed() - 0.98).abs() < 1e-9, "written late after all");
    }

    #[test]
    fn the_rate_rises_within_its_limits_and_ends_at_one() {
        let (mut clock, limits, dt) = (PathClock::default(), RateLimits { first: 5.0, second: 100.0 }, 0.01);
        clock.rewind(Mono::ZERO, Mono::ZERO);
        let (mut rate, mut change, mut steps) = (0.0, 0.0, 0);
        while !clock.runs_at(1.0) {
            clock.approach(1.0, limits, dt);
            let now = (clock.rate() - rate) / dt;
            assert!(now <= 5.0 + 1e-9 && (now - change).abs() <= 100.0 * dt + 1e-6, "{now} after {change}");
            (rate, change, steps) = (clock.rate(), now, steps + 1);
            assert!(steps < 200);
        }
        assert!(steps > 20);
    }
}
