//! What a trajectory really does, measured on its spline: the part of each limit that it uses.

use crate::trajectory::{Cursor, JointTrajectory, Sample, Spline, TrajectoryError};

use super::topp::JointBound;

/// The largest parts of the limits that a trajectory uses: above 1 it exceeds them.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Excess {
    /// Part of the velocity limit.
    pub velocity: f64,
    /// Part of the acceleration limit.
    pub acceleration: f64,
    /// Part of the jerk limit; 0 where there is none.
    pub jerk: f64,
}

impl Excess {
    /// By which factor the motion must be slower to keep all limits; at least 1.
    pub fn slower(&self) -> f64 {
        self.velocity.max(self.acceleration.sqrt()).max(self.jerk.cbrt()).max(1.0)
    }
}

/// Samples of a segment.
const SAMPLES: usize = 4;

impl Excess {
    /// What it is when the motion takes `factor` times as long.
    pub fn stretched(self, factor: f64) -> Self {
        Self {
            velocity: self.velocity / factor,
            acceleration: self.acceleration / factor.powi(2),
            jerk: self.jerk / factor.powi(3),
        }
    }

    /// The larger of each.
    pub fn max(self, other: Self) -> Self {
        Self {
            velocity: self.velocity.max(other.velocity),
            acceleration: self.acceleration.max(other.acceleration),
            jerk: self.jerk.max(other.jerk),
        }
    }
}

/// Measures a trajectory. Where points state velocities alone their curve is a cubic, whose extremes are known; else
/// every segment is sampled, ends included from both sides, and jerk is taken from the change of acceleration.
pub fn excess(trajectory: &JointTrajectory, bounds: &[JointBound]) -> Result<Excess, TrajectoryError> {
    let cubic = trajectory.points.iter().all(|p| !p.velocities.is_empty() && p.accelerations.is_empty());
    if cubic && bounds.iter().all(|b| b.jerk.is_infinite()) {
        trajectory.validate()?;
        return Ok(of_cubics(trajectory, bounds));
    }
    let spline = Spline::new(trajectory)?;
    let mut cursor = Cursor::default();
    let mut samples = vec![Sample::default(); spline.joints()];
    let mut before = vec![0.0; spline.joints()];
    let mut most = Excess::default();
    for pair in spline.times().windows(2) {
        let (start, length) = (pair[0], pair[1] - pair[0]);
        for k in 0..=SAMPLES {
            // Just inside, so that each end is taken from this segment.
            let part = (k as f64 / SAMPLES as f64).clamp(1e-9, 1.0 - 1e-9);
            spline.sample(start + length * part, &mut cursor, &mut samples);
            for ((s, b), last) in samples.iter().zip(bounds).zip(&mut before) {
                most.velocity = most.velocity.max(s.velocity.abs() / b.velocity);
                most.acceleration = most.acceleration.max(s.acceleration.abs() / b.acceleration);
                let change = (s.acceleration - *last).abs() / (length / SAMPLES as f64);
                most.jerk = most.jerk.max(if k == 0 { 0.0 } else { change / b.jerk });
                *last = s.acceleration;
            }
        }
    }
    Ok(most)
}

fn of_cubics(trajectory: &JointTrajectory, bounds: &[JointBound]) -> Excess {
    let mut most = Excess::default();
    for pair in trajectory.points.windows(2) {
        let h = pair[1].time_from_start - pair[0].time_from_start;
        for (j, bound) in bounds.iter().enumerate() {
            let (v0, v1) = (pair[0].velocities[j], pair[1].velocities[j]);
            let d = (pair[1].positions[j] - pair[0].positions[j]) / h;
            // Acceleration goes from a0 to a1 in a straight line; velocity has its extreme where it is zero.
            let (a0, a1) = ((6.0 * d - 4.0 * v0 - 2.0 * v1) / h, (2.0 * v0 + 4.0 * v1 - 6.0 * d) / h);
            let mut speed = v0.abs().max(v1.abs());
            if a0 * a1 < 0.0 {
                speed = speed.max((v0 - 0.5 * a0 * a0 * h / (a1 - a0)).abs());
            }
            most.velocity = most.velocity.max(speed / bound.velocity);
            most.acceleration = most.acceleration.max(a0.abs().max(a1.abs()) / bound.acceleration);
        }
    }
    most
}
