//! A direct motion from rest to rest, for `move`: a straight line in joint space. Computed outside the tick.
//!
//! The line is passed with a double-S profile ([`double_s`](dimos_core::double_s)), the one of planned motions. Between
//! two changes of jerk each joint follows a cubic, so points at all changes, with positions and velocities, reproduce
//! the motion exactly.

use dimos_core::double_s::LineLimits;
use dimos_core::joint::{JointBounds, JointLimits};
use dimos_core::trajectory::{JointTrajectory, JointValues, TrajectoryPoint};

/// Points closer together than this are merged [s].
const SAME_TIME: f64 = 1e-6;
/// Duration of the shortest motion [s], also of one to the present position.
const SHORTEST: f64 = 0.05;

/// Why there is no motion.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MotionError {
    /// A target is outside its joint's limits.
    #[error("{joint} would go to {target:.4} rad, outside its limits {lower:.4} … {upper:.4} rad by {excess:.4} rad")]
    OutOfLimits {
        /// The joint.
        joint: String,
        /// Its target [rad].
        target: f64,
        /// Lowest commanded position [rad].
        lower: f64,
        /// Highest commanded position [rad].
        upper: f64,
        /// Distance of the target from that range [rad].
        excess: f64,
    },
    /// The path has no time parameterization.
    #[error("no motion found: {0}")]
    NotFound(String),
}

/// Returns the fastest motion on the straight line from `start` to `target` [rad] within the limits, stretched in time
/// by 1 / `speed` (0–1]. `start`, `target` and `limits` have a value for each joint.
#[allow(clippy::indexing_slicing, reason = "a value for each joint; not on the tick's path")]
pub fn point_to_point(
    joints: &[String],
    start: &[f64],
    target: &[f64],
    limits: &JointLimits,
    speed: f64,
) -> Result<JointTrajectory, MotionError> {
    for (j, joint) in joints.iter().enumerate() {
        let bounds = JointBounds::inside(limits.position_lower[j], limits.position_upper[j], 1.0, 1.0);
        // A joint that starts outside its limits may stay or move in.
        let (lower, upper) = (bounds.lower.min(start[j]), bounds.upper.max(start[j]));
        let excess = (lower - target[j]).max(target[j] - upper);
        if excess.is_nan() || excess > 1e-9 {
            return Err(MotionError::OutOfLimits { joint: joint.clone(), target: target[j], lower, upper, excess });
        }
    }
    let way: JointValues = start.iter().zip(target).map(|(a, b)| b - a).collect();
    // Along the line the position is 0 at the start and 1 at the target.
    let most = |limits: &[f64]| way.iter().zip(limits).map(|(d, most)| most / d.abs()).fold(f64::INFINITY, f64::min);
    let line = LineLimits {
        speed: most(&limits.velocity_max),
        acceleration: most(&limits.acceleration_max),
        jerk: most(&limits.jerk_max),
    };
    let point = |time_from_start: f64, at: f64, speed: f64| TrajectoryPoint {
        time_from_start,
        positions: start.iter().zip(&way).map(|(a, d)| a + d * at).collect(),
        velocities: way.iter().map(|d| d * speed).collect(),
        accelerations: JointValues::new(),
    };
    let mut points = vec![point(0.0, 0.0, 0.0)];
    let mut duration = 0.0;
    if line.speed.is_finite() {
        line.travel(0.0, 0.0, 1.0, |state| {
            if state.time - points.last().map_or(0.0, |last| last.time_from_start) >= SAME_TIME {
                points.push(point(state.time, state.at, state.speed));
            }
            duration = state.time;
        });
    }
    if duration < SHORTEST * speed {
        points.truncate(1);
        duration = SHORTEST * speed;
    } else {
        // The end, in place of a point just before it.
        points.truncate((points.len() - 1).max(1));
    }
    points.push(TrajectoryPoint { positions: target.into(), ..point(duration, 1.0, 0.0) });
    Ok(JointTrajectory { joint_names: joints.to_vec(), points }.scaled(speed))
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_core::trajectory::{Cursor, Sample, Spline};
    use proptest::prelude::*;

    fn limits(n: usize) -> JointLimits {
        JointLimits::uniform(n, 3.0, 1.5).with_defaults()
    }

    proptest! {
        #[test]
        fn every_motion_arrives_and_keeps_its_limits(
            start in prop::collection::vec(-2.9f64..2.9, 6),
            target in prop::collection::vec(-2.9f64..2.9, 6),
            speed in 0.1f64..1.0,
        ) {
            let names = dimos_core::joint::make_joints("arm", 6);
            let l = limits(6);
            let motion = point_to_point(&names, &start, &target, &l, speed).unwrap();
            let spline = Spline::new(&motion).unwrap();
            let (mut cursor, mut s) = (Cursor::default(), [Sample::default(); 6]);
            let mut before: Option<[Sample; 6]> = None;
            let h = 1e-3;
            for k in 0..=(spline.duration() / h) as usize {
                spline.sample(k as f64 * h, &mut cursor, &mut s);
                for j in 0..6 {
                    // On the straight line, at the same part of it as the first joint.
                    let (way, first) = (target[j] - start[j], target[0] - start[0]);
                    let off = (s[j].position - start[j]) * first - (s[0].position - start[0]) * way;
                    prop_assert!(off.abs() < 1e-9, "off the line by {off}");
                    prop_assert!(s[j].velocity.abs() <= l.velocity_max[j] * speed * (1.0 + 1e-6));
                    prop_assert!(s[j].acceleration.abs() <= l.acceleration_max[j] * speed * speed * (1.0 + 1e-4) + 1e-6);
                    if let Some(b) = before {
                        let jerk = (s[j].acceleration - b[j].acceleration).abs() / h;
                        prop_assert!(jerk <= l.jerk_max[j] * speed.powi(3) * 1.01 + 1e-3, "jerk {jerk}");
                    }
                }
                before = Some(s);
            }
            for j in 0..6 {
                prop_assert_eq!(spline.start(j), start[j]);
                prop_assert!((spline.goal(j) - target[j]).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn a_target_outside_names_the_joint_and_the_amount() {
        let names = dimos_core::joint::make_joints("arm", 2);
        let said = point_to_point(&names, &[0.0, 0.0], &[0.0, 3.2], &limits(2), 1.0).unwrap_err().to_string();
        assert!(said.contains("arm_joint2") && said.contains("by 0.2100 rad"), "{said}");
        assert!(point_to_point(&names, &[0.0, 0.0], &[0.0, f64::NAN], &limits(2), 1.0).is_err());
    }

    /// The joint that takes longest determines the duration if all have the same ratio of their limits.
    #[test]
    fn the_duration_is_that_of_the_slowest_joint_and_speed_stretches_it() {
        let names = dimos_core::joint::make_joints("arm", 3);
        let l = limits(3);
        let motion = |target: [f64; 3], speed| point_to_point(&names, &[0.0; 3], &target, &l, speed).unwrap();
        let (v, a, j) = (l.velocity_max[0], l.acceleration_max[0], l.jerk_max[0]);
        let expected = 2.0 / v + v / a + a / j;
        assert!((motion([0.4, -2.0, 1.0], 1.0).duration() - expected).abs() < 1e-9);
        assert!((motion([0.4, -2.0, 1.0], 0.2).duration() - 5.0 * expected).abs() < 1e-9);
        assert!((motion([0.0, 1e-9, 0.0], 0.2).duration() - SHORTEST).abs() < 1e-12);
    }

    /// At 2 a³/j² the acceleration is reached for an instant.
    #[test]
    fn a_distance_between_two_shapes_of_profile_is_found() {
        let names = dimos_core::joint::make_joints("arm", 1);
        for (a, j) in [(10.0, 100.0), (2.0, 20.0), (3.0, 30.0)] {
            let l = JointLimits { acceleration_max: vec![a], jerk_max: vec![j], ..JointLimits::uniform(1, 3.0, 3.0) };
            for speed in [0.1, 0.2, 0.5, 0.8, 1.0] {
                let target = 2.0 * a * a * a / (j * j);
                let motion = point_to_point(&names, &[0.0], &[target], &l, speed).unwrap();
                assert_eq!(motion.points.last().unwrap().positions[..], [target]);
                let e = Spline::new(&motion).unwrap().extremes(0);
                assert!(e.steepest <= a * speed * speed * (1.0 + 1e-4), "{e:?}");
            }
        }
    }

    #[test]
    fn an_arm_that_is_there_already_stays() {
        let names = dimos_core::joint::make_joints("arm", 2);
        let motion = point_to_point(&names, &[0.4, 0.1], &[0.4, 0.1], &limits(2), 1.0).unwrap();
        assert!(Spline::new(&motion).is_ok());
    }
}
