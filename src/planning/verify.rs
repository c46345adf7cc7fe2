//! Measures how much of each limit a trajectory uses, on the curve between its points.

use crate::trajectory::TrajectoryPoint;

use super::four::Four;
use super::topp::JointBound;

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

/// Largest effect of rounding of positions on the factors of a quintic's speed: thirty times four units.
const POSITION_ROUNDING: f64 = 120.0 * f64::EPSILON;
/// Measures the curve through points with velocities and, all or none, accelerations: cubic or quintic, as in `Spline`.
/// The values are upper bounds, exact where the acceleration is constant, or linear without a change of its sign. If
/// these exceed a limit, they are the extremes of cubics, and quintics are sampled in quarters of each segment.
pub fn excess(points: &[TrajectoryPoint], bounds: &[JointBound]) -> Excess {
    let quintic = points.iter().all(|p| !p.accelerations.is_empty());
    let most = upper_bounds(points, bounds, quintic);
    if most.slower() <= 1.0 {
        return most;
    }
    // Maximum speed, acceleration and jerk per joint.
    let mut most = vec![[0.0; 3]; bounds.len()];
    for pair in points.windows(2) {
        let (a, b) = (&pair[0], &pair[1]);
        let h = b.time_from_start - a.time_from_start;
        let inverse = 1.0 / h;
        for (j, most) in most.iter_mut().enumerate() {
            let d = (b.positions[j] - a.positions[j]) * inverse;
            let speeds = (a.velocities[j], b.velocities[j]);
            let used = if quintic {
                of_quintic(d, speeds, (a.accelerations[j], b.accelerations[j]), h, inverse)
            } else {
                of_cubic(d, speeds, h, inverse)
            };
            most.iter_mut().zip(used).for_each(|(m, u)| *m = larger(*m, u));
        }
    }
    most.iter().zip(bounds).fold(Excess::default(), |all, (&[velocity, acceleration, jerk], bound)| {
        all.max(Excess {
            velocity: velocity / bound.velocity,
            acceleration: acceleration / bound.acceleration,
            jerk: jerk / bound.jerk,
        })
    })
}

fn larger(a: f64, b: f64) -> f64 {
    if b > a { b } else { a }
}

/// Returns the maximum speed, acceleration and jerk of a cubic with mean speed `d` over `h`.
fn of_cubic(d: f64, (v0, v1): (f64, f64), h: f64, inverse: f64) -> [f64; 3] {
    // Acceleration is linear from a0 to a1; velocity has its extreme where it is zero.
    let (a0, a1) = ((6.0 * d - 4.0 * v0 - 2.0 * v1) * inverse, (2.0 * v0 + 4.0 * v1 - 6.0 * d) * inverse);
    let mut speed = larger(v0.abs(), v1.abs());
    if a0 * a1 < 0.0 {
        speed = larger(speed, (v0 - 0.5 * a0 * a0 * h / (a1 - a0)).abs());
    }
    [speed, larger(a0.abs(), a1.abs()), (a1 - a0).abs() * inverse]
}

/// Returns the maximum speed, acceleration and jerk of a quintic with mean speed `d` over `h`.
fn of_quintic(d: f64, (v0, v1): (f64, f64), (a0, a1): (f64, f64), h: f64, inverse: f64) -> [f64; 3] {
    // Speed is v0 + x·(c1 + x·(c2 + x·(c3 + x·c4))), with x from 0 to 1.
    let (c1, b1) = (a0 * h, a1 * h);
    let (rise, change) = (d - v0, v1 - v0);
    let c2 = 30.0 * rise - 12.0 * change - 4.5 * c1 + 1.5 * b1;
    let c3 = -60.0 * rise + 28.0 * change + 6.0 * c1 - 4.0 * b1;
    let c4 = 30.0 * rise - 15.0 * change - 2.5 * c1 + 2.5 * b1;
    let speed = |x: f64| (v0 + x * (c1 + x * (c2 + x * (c3 + x * c4)))).abs();
    let acceleration = |x: f64| (c1 + x * (2.0 * c2 + x * (3.0 * c3 + x * 4.0 * c4))).abs();
    let jerk = |x: f64| (2.0 * c2 + x * (6.0 * c3 + x * 12.0 * c4)).abs();
    let most = |ends: f64, f: &dyn Fn(f64) -> f64| larger(larger(ends, f(0.25)), larger(f(0.5), f(0.75)));
    [
        most(larger(v0.abs(), v1.abs()), &speed),
        most(larger(c1.abs(), b1.abs()), &acceleration) * inverse,
        most(larger(jerk(0.0), jerk(1.0)), &jerk) * inverse * inverse,
    ]
}

/// Returns upper bounds of what the spline through points uses.
fn upper_bounds(points: &[TrajectoryPoint], bounds: &[JointBound], quintic: bool) -> Excess {
    let Some(start) = points.first() else { return Excess::default() };
    let mut all = Excess::default();
    for first in Four::starts(bounds.len()) {
        let state = |p: &TrajectoryPoint| {
            [Four::load(&p.positions, first), Four::load(&p.velocities, first), Four::load(&p.accelerations, first)]
        };
        let (mut before, mut time) = (state(start), start.time_from_start);
        let mut most = [Four::default(); 3];
        for point in &points[1..] {
            let (now, h) = (state(point), point.time_from_start - time);
            let used = if quintic { bound_of_quintic(&before, &now, h) } else { bound_of_cubic(&before, &now, h) };
            let [speed, acceleration, jerk] = used;
            most = [most[0].max(speed), most[1].max(acceleration), most[2].max(jerk)];
            (before, time) = (now, point.time_from_start);
        }
        for (k, bound) in bounds[first..].iter().take(Four::LEN).enumerate() {
            all = all.max(Excess {
                velocity: most[0].0[k] / bound.velocity,
                acceleration: most[1].0[k] / bound.acceleration,
                jerk: most[2].0[k] / bound.jerk,
            });
        }
    }
    all
}

/// Returns upper bounds of the speed, acceleration and jerk of a segment of duration `h` between two states: position,
/// velocity, acceleration.
#[inline(always)]
fn bound_of_quintic(&[p0, v0, a0]: &[Four; 3], &[p1, v1, a1]: &[Four; 3], h: f64) -> [Four; 3] {
    let inverse = 1.0 / h;
    // Speed is v0 + x·(c1 + x·(c2 + x·(c3 + x·c4))), with x from 0 to 1 and c1 = a0·h. In a cubic, `second` and `first`
    // would be 0: what v1 and p1 are beyond a linear acceleration. Then c4 = 30·first, c3 = −60·first − 2·second.
    let (c1, b1) = (a0 * h, a1 * h);
    let bend = b1 - c1;
    let second = (v1 - v0 - (c1 + b1) * 0.5).abs();
    let first = ((p1 - p0) * inverse - (v0 + v1) * 0.5 + bend * (1.0 / 12.0)).abs() * 30.0;
    let noise = p0.abs().max(p1.abs()) * (POSITION_ROUNDING * inverse);
    let (first, bend) = ((first - noise).max(Four::default()), bend.abs());
    // Beyond the line between the values at the ends: at most 1/4 of a square's factor, 0.385 of a cube's and 0.473 of
    // a fourth power's. A speed whose acceleration does not change its sign has its extremes at the ends.
    let turns = (c1 * b1).where_negative(0.25);
    let speed = v0.abs().max(v1.abs()) + first * 1.25 + second * 0.8 + turns * (first + second * 3.0 + bend * 0.5);
    let acceleration = c1.abs().max(b1.abs()) + first * 3.04 + second * 1.5;
    // Beyond its mean.
    let jerk = bend + first * 14.0 + second * 6.0;
    [speed, acceleration * inverse, jerk * (inverse * inverse)]
}

/// Returns upper bounds of the speed, acceleration and jerk of a segment of duration `h` between two states: position,
/// velocity.
#[inline(always)]
fn bound_of_cubic(&[p0, v0, _]: &[Four; 3], &[p1, v1, _]: &[Four; 3], h: f64) -> [Four; 3] {
    let inverse = 1.0 / h;
    let d = (p1 - p0) * (6.0 * inverse);
    // Change of speed over the segment at the rate of either end.
    let (c0, c1) = (d - v0 * 4.0 - v1 * 2.0, v0 * 2.0 + v1 * 4.0 - d);
    let change = (c1 - c0).abs();
    let speed = v0.abs().max(v1.abs()) + (c0 * c1).where_negative(0.125) * change;
    [speed, c0.abs().max(c1.abs()) * inverse, change * (inverse * inverse)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robot::random::Random;
    use crate::trajectory::{Cursor, JointTrajectory, Sample, Spline};

    #[test]
    fn no_sample_of_a_spline_exceeds_the_bounds() {
        let mut random = Random::new(3);
        for (joints, quintic) in [(3, true), (7, true), (7, false), (9, true)] {
            let mut value = |scale: f64| (0..joints).map(|_| random.between(-scale, scale)).collect::<Vec<f64>>();
            let point = |k: usize, value: &mut dyn FnMut(f64) -> Vec<f64>| TrajectoryPoint {
                time_from_start: 0.3 * k as f64,
                positions: value(1.0),
                velocities: value(1.0),
                accelerations: if quintic { value(2.0) } else { Vec::new() },
            };
            let points: Vec<_> = (0..20).map(|k| point(k, &mut value)).collect();
            let limits = vec![JointBound { velocity: 2.0, acceleration: 30.0, jerk: 500.0 }; joints];
            let most = upper_bounds(&points, &limits, quintic);
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
}
