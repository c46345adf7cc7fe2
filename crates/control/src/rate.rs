//! A rate that changes within limits of its first and second derivative.

use dimos_core::joint::braking_speed;

/// Fraction of the limits that a change uses; the remainder is for the path's curvature and for rounding.
const SHARE: f64 = 0.9;

/// Limits of the change of a rate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RateLimits {
    /// Maximum change of the rate [1/s].
    pub first: f64,
    /// Maximum change of that change [1/s²].
    pub second: f64,
}

/// A rate from 0 to 1, with its change.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rate {
    value: f64,
    /// [1/s]
    change: f64,
}

impl Rate {
    /// Creates a constant rate.
    pub fn new(value: f64) -> Self {
        Self { value, change: 0.0 }
    }

    /// Returns its value.
    pub fn value(&self) -> f64 {
        self.value
    }

    /// Changes it towards `target` over a step of `dt` [s].
    pub fn approach(&mut self, target: f64, limits: RateLimits, dt: f64) {
        if self.value == target || dt <= 0.0 {
            return;
        }
        let (first, second) = (SHARE * limits.first, SHARE * limits.second);
        let rises = target > self.value;
        // The fastest change from which the rate still reaches the target with zero change.
        let arriving = braking_speed((target - self.value).abs(), second, dt);
        let wanted = if rises { first.min(arriving) } else { -first.min(arriving) };
        self.change += (wanted - self.change).clamp(-second * dt, second * dt);
        // It never runs backwards, and not too fast when the target falls while it rises.
        self.value = (self.value + self.change * dt).clamp(0.0, 1.0);
        let arrived = if rises { self.value >= target - 1e-9 } else { self.value <= target + 1e-9 };
        if arrived || !self.value.is_finite() {
            *self = Self::new(target);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: RateLimits = RateLimits { first: 5.0, second: 100.0 };
    const DT: f64 = 0.01;

    #[test]
    fn any_target_is_reached_within_the_limits_also_one_that_changes_on_the_way() {
        let mut rate = Rate::new(1.0);
        let mut change = 0.0;
        for (target, ticks) in [(0.3, 8), (1.0, 9), (0.0, 200), (0.05, 100), (1.0, 200)] {
            for _ in 0..ticks {
                let before = rate.value();
                rate.approach(target, LIMITS, DT);
                let (now, ends) = ((rate.value() - before) / DT, rate.value() == target);
                assert!(now.abs() <= LIMITS.first + 1e-9, "{now}");
                assert!((now - change).abs() <= 1.01 * LIMITS.second * DT, "{now} after {change}");
                assert!((0.0..=1.0).contains(&rate.value()));
                change = if ends { 0.0 } else { now };
            }
            assert!(ticks < 10 || rate.value() == target, "{rate:?} instead of {target}");
        }
    }

    #[test]
    fn it_does_not_jump_when_it_arrives() {
        for target in [0.0, 0.3, 1.0] {
            let mut rate = Rate::new(if target > 0.5 { 0.0 } else { 1.0 });
            let mut steps = Vec::new();
            while rate.value() != target {
                let before = rate.value();
                rate.approach(target, LIMITS, DT);
                steps.push((rate.value() - before).abs() / DT);
            }
            assert!(steps.len() > 10 && steps.len() < 200, "{steps:?}");
            // The last two steps, and none after them.
            steps.push(0.0);
            let jumps: Vec<f64> = steps.windows(2).map(|pair| (pair[1] - pair[0]).abs() / DT).collect();
            assert!(jumps.iter().all(|jump| *jump <= 1.01 * LIMITS.second), "{jumps:?}");
        }
    }
}
