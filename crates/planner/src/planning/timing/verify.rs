//! Measures how much of each limit a trajectory uses, on the curve between its points.

use dimos_kernels::Width;
use dimos_kernels::states::{JOINTS, States};

use dimos_core::joint::JointBounds;

/// The largest part of each limit that a trajectory uses: above 1 it exceeds the limit.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Excess {
    /// Part of the velocity limit.
    pub velocity: f64,
    /// Part of the acceleration limit.
    pub acceleration: f64,
    /// Part of the jerk limit; 0 without a limit.
    pub jerk: f64,
}

impl Excess {
    /// Returns the factor by which the motion must be slowed down to keep all limits; at least 1.
    pub fn slower(&self) -> f64 {
        if self.velocity <= 1.0 && self.acceleration <= 1.0 && self.jerk <= 1.0 {
            return 1.0;
        }
        self.velocity.max(self.acceleration.sqrt()).max(self.jerk.cbrt())
    }

    /// Returns the values after stretching the motion in time by `factor`.
    pub fn stretched(self, factor: f64) -> Self {
        Self {
            velocity: self.velocity / factor,
            acceleration: self.acceleration / factor.powi(2),
            jerk: self.jerk / factor.powi(3),
        }
    }

    /// Returns the larger of each.
    pub fn max(self, other: Self) -> Self {
        Self {
            velocity: self.velocity.max(other.velocity),
            acceleration: self.acceleration.max(other.acceleration),
            jerk: self.jerk.max(other.jerk),
        }
    }
}

/// Bounds that exceed a limit by no more than this part need no closer look: they may be rounding errors, and a motion
/// that is slowed down by as little is hardly slower.
const NEGLIGIBLE: f64 = 1e-6;

/// Measures the curve through states: quintic, or cubic, as in `Spline`. The values are upper bounds, exact where the
/// acceleration is constant, or linear without a change of its sign ([`States::most`]). If these exceed a limit, they
/// are the extremes themselves.
pub fn excess(states: &States, bounds: &[JointBounds], quintic: bool) -> Excess {
    let most = upper_bounds(states, bounds, quintic);
    if most.slower() <= 1.0 + NEGLIGIBLE {
        return most;
    }
    (1..states.times().len()).map(|end| of_piece(states, bounds, end, quintic)).fold(Excess::default(), Excess::max)
}

/// Measures each quintic between two states: the extremes of its velocity, acceleration and jerk.
pub fn excess_of_cells(states: &States, bounds: &[JointBounds]) -> Vec<Excess> {
    (1..states.times().len()).map(|end| of_piece(states, bounds, end, true)).collect()
}

/// Measures the piece that ends at a state.
fn of_piece(states: &States, bounds: &[JointBounds], end: usize, quintic: bool) -> Excess {
    let h = states.times()[end] - states.times()[end - 1];
    let inverse = 1.0 / h;
    let mut all = Excess::default();
    for (j, bound) in bounds.iter().enumerate() {
        let [positions, speeds, accelerations] =
            [0, 1, 2].map(|which| [states.values(end - 1, which)[j], states.values(end, which)[j]]);
        let d = (positions[1] - positions[0]) * inverse;
        let used = if quintic {
            of_quintic(d, (speeds, accelerations), (h, inverse), bound)
        } else {
            of_cubic(d, speeds, h, inverse)
        };
        all = all.max(part_of(used, bound));
    }
    all
}

/// Returns the parts of a joint's limits that these are.
fn part_of([velocity, acceleration, jerk]: [f64; 3], bound: &JointBounds) -> Excess {
    Excess {
        velocity: velocity / bound.velocity,
        acceleration: acceleration / bound.acceleration,
        jerk: jerk / bound.jerk,
    }
}

fn larger(a: f64, b: f64) -> f64 {
    if b > a { b } else { a }
}

/// Returns the maximum speed, acceleration and jerk of a cubic with mean speed `d` over `h`.
fn of_cubic(d: f64, [v0, v1]: [f64; 2], h: f64, inverse: f64) -> [f64; 3] {
    // Acceleration is linear from a0 to a1; velocity has its extreme where it is zero.
    let (a0, a1) = ((6.0 * d - 4.0 * v0 - 2.0 * v1) * inverse, (2.0 * v0 + 4.0 * v1 - 6.0 * d) * inverse);
    let mut speed = larger(v0.abs(), v1.abs());
    if a0 * a1 < 0.0 {
        speed = larger(speed, (v0 - 0.5 * a0 * a0 * h / (a1 - a0)).abs());
    }
    [speed, larger(a0.abs(), a1.abs()), (a1 - a0).abs() * inverse]
}

/// Returns the maximum speed, acceleration and jerk of a quintic with mean speed `d` over `h`; of what is within its
/// limit an upper bound.
fn of_quintic(
    d: f64,
    ([v0, v1], [a0, a1]): ([f64; 2], [f64; 2]),
    (h, inverse): (f64, f64),
    limits: &JointBounds,
) -> [f64; 3] {
    // Speed is v0 + x·(c1 + x·(c2 + x·(c3 + x·c4))), with x from 0 to 1.
    let (c1, b1) = (a0 * h, a1 * h);
    let (rise, change) = (d - v0, v1 - v0);
    let c2 = 30.0 * rise - 12.0 * change - 4.5 * c1 + 1.5 * b1;
    let c3 = -60.0 * rise + 28.0 * change + 6.0 * c1 - 4.0 * b1;
    let c4 = 30.0 * rise - 15.0 * change - 2.5 * c1 + 2.5 * b1;
    let speed = |x: f64| v0 + x * (c1 + x * (c2 + x * (c3 + x * c4)));
    let acceleration = |x: f64| c1 + x * (2.0 * c2 + x * (3.0 * c3 + x * 4.0 * c4));
    let jerk = |x: f64| 2.0 * c2 + x * (6.0 * c3 + x * 12.0 * c4);
    // Each has its extremes at the ends and where the next derivative is zero; between two zeros of the jerk the
    // acceleration has one zero at most. What cannot exceed its limit within half of the piece is not searched.
    let turn = -c3 / (4.0 * c4);
    let turn = if turn > 0.0 && turn < 1.0 { turn } else { 0.0 };
    let most_jerk = larger(larger(jerk(0.0).abs(), jerk(1.0).abs()), jerk(turn).abs());
    let (mut most_acceleration, mut most_speed) = (larger(c1.abs(), b1.abs()), larger(v0.abs(), v1.abs()));
    let mut turns = [1.0; 3];
    if most_acceleration + 0.5 * most_jerk > limits.acceleration * h {
        turns[0] = zero_between(jerk, 0.0, turn).unwrap_or(1.0);
        turns[1] = zero_between(jerk, turn, 1.0).unwrap_or(1.0);
        turns[..2].sort_by(f64::total_cmp);
        most_acceleration = turns.iter().fold(most_acceleration, |most, x| larger(most, acceleration(*x).abs()));
    } else {
        most_acceleration += 0.5 * most_jerk;
    }
    if most_speed + 0.5 * most_acceleration > limits.velocity {
        if turns[0] == 1.0 {
            turns[0] = zero_between(jerk, 0.0, turn).unwrap_or(1.0);
            turns[1] = zero_between(jerk, turn, 1.0).unwrap_or(1.0);
            turns[..2].sort_by(f64::total_cmp);
        }
        let mut from = 0.0;
        for to in turns {
            if let Some(still) = zero_between(acceleration, from, to) {
                most_speed = larger(most_speed, speed(still).abs());
            }
            from = to;
        }
    } else {
        most_speed += 0.5 * most_acceleration;
    }
    [most_speed, most_acceleration * inverse, most_jerk * inverse * inverse]
}

/// Returns where a function that is monotonic between two places is zero, if its signs there differ.
fn zero_between(f: impl Fn(f64) -> f64, mut low: f64, mut high: f64) -> Option<f64> {
    let negative = f(low) < 0.0;
    if negative == (f(high) < 0.0) {
        return None;
    }
    for _ in 0..52 {
        let middle = 0.5 * (low + high);
        if (f(middle) < 0.0) == negative { low = middle } else { high = middle }
    }
    Some(0.5 * (low + high))
}

/// Returns upper bounds of what the spline through states uses.
fn upper_bounds(states: &States, bounds: &[JointBounds], quintic: bool) -> Excess {
    let mut all = Excess::default();
    for (block, bounds) in bounds.chunks(JOINTS).enumerate() {
        let most = states.most(block, quintic, Width::widest());
        for (k, bound) in bounds.iter().enumerate() {
            all = all.max(part_of([0, 1, 2].map(|which| most[which][k]), bound));
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_core::trajectory::{Cursor, JointTrajectory, Sample, Spline, TrajectoryPoint};
    use dimos_robot::random::Random;

    #[test]
    fn no_sample_of_a_spline_exceeds_the_bounds() {
        let mut random = Random::new(3);
        for (joints, quintic) in [(3, true), (7, true), (7, false), (9, true)] {
            let mut states = States::new(joints, 20);
            for k in 0..20 {
                let three = |_| [1.0, 1.0, 2.0].map(|scale| random.between(-scale, scale));
                states.push(0.3 * k as f64, (0..joints).map(three));
            }
            let point = |(k, time): (usize, &f64)| TrajectoryPoint {
                time_from_start: *time,
                positions: states.values(k, 0).into(),
                velocities: states.values(k, 1).into(),
                accelerations: if quintic { states.values(k, 2).into() } else { Default::default() },
            };
            let points = states.times().iter().enumerate().map(point).collect();
            let limits =
                vec![JointBounds { velocity: 2.0, acceleration: 30.0, jerk: 500.0, ..JointBounds::NONE }; joints];
            let most = upper_bounds(&states, &limits, quintic);
            let names = (0..joints).map(|j| format!("j{j}")).collect();
            let spline = Spline::new(&JointTrajectory { joint_names: names, points }).unwrap();
            let (mut cursor, mut samples) = (Cursor::default(), vec![Sample::default(); joints]);
            for k in 0..=5700 {
                spline.sample(f64::from(k) * 1e-3, &mut cursor, &mut samples);
                for s in &samples {
                    assert!(s.velocity.abs() / 2.0 <= most.velocity + 1e-9, "{joints} {quintic}: {s:?}, {most:?}");
                    assert!(s.acceleration.abs() / 30.0 <= most.acceleration + 1e-9, "{joints} {quintic}: {s:?}");
                }
            }
        }
    }

    /// Extremes between samples are found: a circle of 720 points once had 1.5 % more jerk than was said.
    #[test]
    fn the_extremes_of_quintics_are_exact_where_limits_are_exceeded() {
        let mut random = Random::new(8);
        for _ in 0..1000 {
            let mut states = States::new(1, 2);
            let h = random.between(0.01, 0.5);
            for time in [0.0, h] {
                let three = [1.0, 1.0, 2.0].map(|scale| random.between(-scale, scale));
                states.push(time, std::iter::once(three));
            }
            let limits = [JointBounds { velocity: 1e-3, acceleration: 1e-3, jerk: 1e-3, ..JointBounds::NONE }];
            let found = excess(&states, &limits, true);
            let point = |k: usize| TrajectoryPoint {
                time_from_start: states.times()[k],
                positions: states.values(k, 0).into(),
                velocities: states.values(k, 1).into(),
                accelerations: states.values(k, 2).into(),
            };
            let points = vec![point(0), point(1)];
            let spline = Spline::new(&JointTrajectory { joint_names: vec!["j".into()], points }).unwrap();
            let (mut cursor, mut sample) = (Cursor::default(), [Sample::default()]);
            let (mut most, mut last): ([f64; 3], Option<f64>) = ([0.0; 3], None);
            let step = h / 4000.0;
            // At its end a motion rests.
            for k in 0..4000 {
                spline.sample(f64::from(k) * step, &mut cursor, &mut sample);
                let Sample { velocity, acceleration, .. } = sample[0];
                let jerk = last.map_or(0.0, |last| (acceleration - last) / step);
                last = Some(acceleration);
                for (most, value) in most.iter_mut().zip([velocity, acceleration, jerk]) {
                    *most = most.max(value.abs());
                }
            }
            for (found, sampled) in [found.velocity, found.acceleration, found.jerk].iter().zip(most) {
                let ratio = found * 1e-3 / sampled;
                assert!((1.0 - 1e-6..1.004).contains(&ratio), "{ratio}: {found}, {sampled}");
            }
        }
    }
}
