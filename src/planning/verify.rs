//! Measures how much of each limit a trajectory uses, on the curve between its points.

use crate::trajectory::TrajectoryPoint;

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

/// Measures the curve through points with velocities and, all or none, accelerations: cubic or quintic, as in `Spline`.
/// The extremes of cubics are exact; quintics are sampled in quarters of each segment.
pub fn excess(points: &[TrajectoryPoint], bounds: &[JointBound]) -> Excess {
    let quintic = points.iter().all(|p| !p.accelerations.is_empty());
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
