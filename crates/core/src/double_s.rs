//! Motion along a line from one speed to another, in the least time that limits of speed, acceleration and jerk allow:
//! the double-S profile (Biagiotti and Melchiorri, "Trajectory Planning for Automatic Machines and Robots", 2008,
//! section 3.4). The acceleration is zero at both ends and while cruising.

/// Limits along a line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LineLimits {
    /// Maximum speed [rad/s].
    pub speed: f64,
    /// Maximum acceleration [rad/s²].
    pub acceleration: f64,
    /// Maximum jerk [rad/s³]; infinite without a limit.
    pub jerk: f64,
}

/// State at the end of a phase of constant jerk.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct State {
    /// Time from the start of the line [s].
    pub time: f64,
    /// Position from the start of the line [rad].
    pub at: f64,
    /// Speed [rad/s].
    pub speed: f64,
    /// Acceleration [rad/s²].
    pub acceleration: f64,
}

/// Maximum steps of a search for a speed.
const STEPS: usize = 60;

impl LineLimits {
    /// Change of speed [rad/s] from which the full acceleration is reached.
    #[inline]
    fn full(&self) -> f64 {
        self.acceleration * self.acceleration / self.jerk
    }

    /// Returns the time to change the speed by `change` [s].
    #[inline]
    fn time(&self, change: f64) -> f64 {
        if change >= self.full() {
            change / self.acceleration + self.acceleration / self.jerk
        } else {
            2.0 * (change / self.jerk).sqrt()
        }
    }

    /// Returns the distance to change between two speeds [rad].
    #[inline]
    pub fn distance(&self, a: f64, b: f64) -> f64 {
        0.5 * (a + b) * self.time((b - a).abs())
    }

    /// Returns the highest speed, at most `most`, that is reached from `from` within `length`.
    #[inline]
    pub fn reached(&self, from: f64, most: f64, length: f64) -> f64 {
        if most <= from || self.distance(from, most) <= length {
            return most;
        }
        let full = self.full();
        // (v² − from²)/2a + (v + from)·a/2j = length, if the full acceleration is reached.
        let v = ((from - 0.5 * full).powi(2) + 2.0 * self.acceleration * length).sqrt() - 0.5 * full;
        if v - from >= full {
            return v.min(most);
        }
        // j·w³ + 2·from·w = length, for half of the time, w. Convex: Newton's method from the right does not overshoot.
        let mut w = (self.acceleration / self.jerk).min((length / self.jerk).cbrt());
        for _ in 0..STEPS {
            let step = (w * (self.jerk * w * w + 2.0 * from) - length) / (3.0 * self.jerk * w * w + 2.0 * from);
            if step <= 1e-12 * w {
                break;
            }
            w -= step;
        }
        (from + self.jerk * w * w).min(most)
    }

    /// Returns the highest speed on a line of this length between two speeds at its ends, which it reaches.
    fn peak(&self, from: f64, to: f64, length: f64) -> f64 {
        let lowest = from.max(to);
        let needed = |v: f64| self.distance(from, v) + self.distance(v, to);
        if needed(self.speed) <= length {
            return self.speed.max(lowest);
        }
        // v²/a + v·a/j = rest, if the full acceleration is reached on both sides.
        let (a, full) = (self.acceleration, self.full());
        let rest = length + 0.5 * (from * from + to * to) / a - 0.5 * (from + to) * a / self.jerk;
        let v = 0.5 * ((full * full + 4.0 * a * rest).max(0.0).sqrt() - full);
        if v - from.min(to) >= full && v - lowest >= full {
            return v.min(self.speed);
        }
        // The distance grows with the speed: regula falsi, with the Illinois rule.
        let (mut low, mut high) = (lowest, self.speed.max(lowest));
        let (mut short, mut over) = (length - needed(low), needed(high) - length);
        for _ in 0..STEPS {
            let v = (low + (high - low) * short / (short + over)).clamp(low, high);
            let off = needed(v) - length;
            if off <= 0.0 {
                (low, short, over) = (v, -off, 0.5 * over);
                if -off <= 1e-9 * length {
                    break;
                }
            } else {
                (high, over, short) = (v, off, 0.5 * short);
            }
        }
        low
    }

    /// Returns how long [`travel`](Self::travel) takes [s].
    pub fn duration(&self, from: f64, to: f64, length: f64) -> f64 {
        let peak = self.peak(from, to, length);
        let cruise = length - self.distance(from, peak) - self.distance(peak, to);
        self.time((peak - from).abs()) + cruise.max(0.0) / peak + self.time((peak - to).abs())
    }

    /// Calls `see` with the state at the end of every phase of the quickest motion from speed `from` to speed `to` over
    /// `length`; the last is the end of the line. The speeds are such that the line is long enough.
    pub fn travel(&self, from: f64, to: f64, length: f64, mut see: impl FnMut(State)) {
        let peak = self.peak(from, to, length);
        let mut now = State { speed: from, ..State::default() };
        self.change(&mut now, peak, &mut see);
        let cruise = length - now.at - self.distance(peak, to);
        if cruise > 0.0 {
            now.time += cruise / peak;
            now.at += cruise;
            see(now);
        }
        self.change(&mut now, to, &mut see);
    }

    /// Changes the speed: jerk, constant acceleration, opposite jerk.
    fn change(&self, now: &mut State, to: f64, see: &mut impl FnMut(State)) {
        let (begin, change, sign) = (*now, (to - now.speed).abs(), (to - now.speed).signum());
        if change <= 0.0 {
            return;
        }
        let (whole, end) = (self.time(change), begin.at + self.distance(begin.speed, to));
        let ramp = if change >= self.full() { self.acceleration / self.jerk } else { 0.5 * whole };
        if ramp > 0.0 {
            let acceleration = sign * ramp * self.jerk;
            let at = begin.at + ramp * (begin.speed + ramp * acceleration / 6.0);
            let first =
                State { time: begin.time + ramp, at, speed: begin.speed + 0.5 * ramp * acceleration, acceleration };
            see(first);
            if whole > 2.0 * ramp {
                let at = end - ramp * (to - ramp * acceleration / 6.0);
                let speed = to - 0.5 * ramp * acceleration;
                see(State { time: begin.time + whole - ramp, at, speed, acceleration });
            }
        }
        *now = State { time: begin.time + whole, at: end, speed: to, acceleration: 0.0 };
        see(*now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Limits, the speeds at both ends of a line, and its length: the line is long enough for them.
    fn line() -> impl Strategy<Value = (LineLimits, f64, f64, f64)> {
        let jerk = prop_oneof![1 => Just(f64::INFINITY), 3 => 1.0..500.0];
        (0.2..4.0, 0.5..20.0, jerk, 0.0..1.0, 1e-4..3.0, 0.0..1.0).prop_map(
            |(speed, acceleration, jerk, from, length, to): (f64, f64, f64, f64, f64, f64)| {
                let limits = LineLimits { speed, acceleration, jerk };
                let from = from * speed;
                let to = limits.reached(from, speed, length) * to;
                (limits, from.min(limits.reached(to, speed, length)), to, length)
            },
        )
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2000))]

        #[test]
        fn a_line_ends_where_and_as_fast_as_asked_within_its_limits((limits, from, to, length) in line()) {
            let mut last = State { speed: from, ..State::default() };
            let mut wrong = None;
            limits.travel(from, to, length, |s| {
                let dt = s.time - last.time;
                let mut see = |right: bool, what: &str| {
                    if !right {
                        wrong.get_or_insert(format!("{what}: {s:?} from {last:?}"));
                    }
                };
                see(dt >= 0.0 && s.at >= last.at - 1e-9, "back");
                see(s.speed <= limits.speed * (1.0 + 1e-9) && s.speed >= -1e-9, "speed limit");
                see(s.acceleration.abs() <= limits.acceleration * (1.0 + 1e-9), "acceleration limit");
                if limits.jerk.is_finite() {
                    // Constant jerk: position and speed follow from the accelerations.
                    let (a0, a1) = (last.acceleration, s.acceleration);
                    see((a1 - a0).abs() <= limits.jerk * dt * (1.0 + 1e-9) + 1e-9, "jerk limit");
                    see((last.speed + 0.5 * dt * (a0 + a1) - s.speed).abs() < 1e-6, "speed");
                    see((last.at + dt * (last.speed + dt * (2.0 * a0 + a1) / 6.0) - s.at).abs() < 1e-6, "position");
                } else {
                    see((s.speed - last.speed).abs() <= limits.acceleration * dt + 1e-9, "acceleration");
                    see((last.at + 0.5 * dt * (last.speed + s.speed) - s.at).abs() < 1e-6, "position");
                }
                last = s;
            });
            prop_assert!(wrong.is_none(), "{limits:?} from {from} to {to} over {length}: {wrong:?}");
            prop_assert!((last.at - length).abs() < 1e-6 && (last.speed - to).abs() < 1e-9, "{last:?}");
        }

        #[test]
        fn no_slower_profile_is_chosen_than_one_that_peaks_a_little_higher_would_allow(
            (limits, from, to, length) in line()
        ) {
            let peak = limits.peak(from, to, length);
            let higher = peak + 1e-6;
            let fits = limits.distance(from, higher) + limits.distance(higher, to) <= length;
            prop_assert!(higher > limits.speed || !fits || peak <= from.max(to), "{peak}");
        }
    }

    /// Closed forms of the duration from rest to rest: speed limit reached, only the acceleration limit, neither.
    #[test]
    fn from_rest_to_rest_the_duration_is_that_of_the_closed_form() {
        let limits = LineLimits { speed: 1.5, acceleration: 4.0, jerk: 40.0 };
        let (v, a, j) = (limits.speed, limits.acceleration, limits.jerk);
        for (length, duration) in [
            (2.0, 2.0 / v + v / a + a / j),
            (0.3, a / j + ((a / j) * (a / j) + 4.0 * 0.3 / a).sqrt()),
            (0.01, 4.0 * (0.01 / (2.0 * j)).cbrt()),
        ] {
            assert!((limits.duration(0.0, 0.0, length) - duration).abs() < 1e-6, "{length}");
        }
    }
}
