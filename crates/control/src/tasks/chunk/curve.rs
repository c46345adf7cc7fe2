//! The curve of a chunk: a uniform cubic B-spline with the actions as control points, so that velocity and acceleration
//! are continuous. Computed outside the tick.
//!
//! A policy's actions are noisy, and noise at 30 Hz is much jerk. The actions are therefore filtered, forward and
//! backward alike (no delay), until the curve needs no more than its share of the limits.

use dimos_core::joint::JointLimits;
use dimos_core::trajectory::{JointTrajectory, TrajectoryPoint};

/// Share of the acceleration and jerk limits for the curve; the rest is for blending with the motion before it.
pub(super) const SHARE: f64 = 0.5;
/// Maximum number of passes of the filter: with all of them, changes within about 10 actions are lost.
const MAX_PASSES: usize = 64;

/// Returns the curve through actions [rad], one row per action, `period` [s] apart. `joints` and `limits` are those of
/// the columns. Its velocity is not limited: a chunk that is too fast should be refused, not altered.
pub fn curve(joints: &[String], actions: &[Vec<f64>], period: f64, limits: &JointLimits) -> JointTrajectory {
    let mut points: Vec<TrajectoryPoint> = (0..actions.len())
        .map(|k| TrajectoryPoint { time_from_start: k as f64 * period, ..TrajectoryPoint::default() })
        .collect();
    for j in 0..joints.len() {
        let column: Vec<f64> = actions.iter().map(|action| action.get(j).copied().unwrap_or(f64::NAN)).collect();
        let limit = |values: &[f64]| values.get(j).copied().unwrap_or(f64::INFINITY);
        let (acceleration, jerk) = (SHARE * limit(&limits.acceleration_max), SHARE * limit(&limits.jerk_max));
        let column = filtered(column, period, acceleration, jerk);
        for (k, point) in points.iter_mut().enumerate() {
            let at = |i: isize| control(&column, k as isize + i);
            point.positions.push((at(-1) + 4.0 * at(0) + at(1)) / 6.0);
            point.velocities.push((at(1) - at(-1)) / (2.0 * period));
            point.accelerations.push((at(1) - 2.0 * at(0) + at(-1)) / (period * period));
        }
    }
    JointTrajectory { joint_names: joints.to_vec(), points }
}

/// Filters actions with the kernel 1, 2, 1 until the curve keeps these limits [rad/s², rad/s³].
fn filtered(mut actions: Vec<f64>, period: f64, acceleration: f64, jerk: f64) -> Vec<f64> {
    for _ in 0..MAX_PASSES {
        let at = |k: usize, i: isize| control(&actions, k as isize + i);
        let keeps = (0..actions.len()).all(|k| {
            let bend = at(k, 1) - 2.0 * at(k, 0) + at(k, -1);
            let next = at(k, 2) - 2.0 * at(k, 1) + at(k, 0);
            bend.abs() <= acceleration * period.powi(2) && (next - bend).abs() <= jerk * period.powi(3)
        });
        if keeps {
            break;
        }
        actions = (0..actions.len()).map(|k| (at(k, -1) + 2.0 * at(k, 0) + at(k, 1)) / 4.0).collect();
    }
    actions
}

/// Returns a control point; beyond the ends they continue on a straight line.
fn control(actions: &[f64], k: isize) -> f64 {
    let last = actions.len() as isize - 1;
    let at = |k: isize| actions.get(k.clamp(0, last.max(0)) as usize).copied().unwrap_or(f64::NAN);
    match k {
        _ if last < 1 => at(0),
        _ if k < 0 => at(0) + k as f64 * (at(1) - at(0)),
        _ if k > last => at(last) + (k - last) as f64 * (at(last) - at(last - 1)),
        _ => at(k),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_robot::random::Random;

    const PERIOD: f64 = 1.0 / 30.0;

    fn limits() -> JointLimits {
        JointLimits { jerk_max: vec![40.0], acceleration_max: vec![8.0], ..JointLimits::uniform(1, 3.0, 2.0) }
    }

    fn of(action: impl Fn(f64) -> f64) -> JointTrajectory {
        let actions: Vec<Vec<f64>> = (0..50).map(|k| vec![action(f64::from(k) * PERIOD)]).collect();
        curve(&["a".to_owned()], &actions, PERIOD, &limits())
    }

    #[test]
    fn a_smooth_chunk_is_followed_as_it_is() {
        let wave = |t: f64| 0.3 * (2.0 * t).sin();
        for point in &of(wave).points[1..49] {
            let t = point.time_from_start;
            assert!((point.positions[0] - wave(t)).abs() < 1e-3, "at {t}: {}", point.positions[0]);
            assert!((point.velocities[0] - 0.6 * (2.0 * t).cos()).abs() < 2e-3, "at {t}: {}", point.velocities[0]);
        }
    }

    #[test]
    fn noise_is_filtered_until_the_curve_keeps_its_share_of_the_jerk_limit() {
        let random = std::cell::RefCell::new(Random::new(7));
        let noisy = of(|t| 0.3 * (2.0 * t).sin() + 0.004 * (random.borrow_mut().unit() - 0.5));
        let accelerations: Vec<f64> = noisy.points.iter().map(|point| point.accelerations[0]).collect();
        for pair in accelerations.windows(2) {
            let jerk = (pair[1] - pair[0]) / PERIOD;
            assert!(jerk.abs() <= 20.0 + 1e-9 && pair[0].abs() <= 4.0 + 1e-9, "{jerk} rad/s³, {} rad/s²", pair[0]);
        }
        for point in &noisy.points {
            let error = point.positions[0] - 0.3 * (2.0 * point.time_from_start).sin();
            assert!(error.abs() < 0.02, "{error}");
        }
    }

    #[test]
    fn a_straight_chunk_keeps_its_velocity_to_both_ends() {
        let line = of(|t| 0.1 + 0.5 * t);
        assert!(line.points.iter().all(|point| (point.velocities[0] - 0.5).abs() < 1e-9));
        assert!(line.points.iter().all(|point| point.accelerations[0].abs() < 1e-9));
        assert!((line.points[0].positions[0] - 0.1).abs() < 1e-12);
    }
}
