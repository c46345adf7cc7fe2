//! A jerk-limited, time-synchronized motion from rest to rest, for `move`. Computed outside the tick.
//!
//! Profiles by Ruckig (Berscheid and Kröger, "Jerk-limited real-time trajectory generation with arbitrary target
//! states", RSS 2021). Between two changes of jerk each joint follows a cubic, so points at all changes, with
//! positions and velocities, reproduce the motion exactly.

use rsruckig::prelude::{DataArrayOrVec, InputParameter, Ruckig, Synchronization, ThrowErrorHandler, Trajectory};

use dimos_core::joint::JointLimits;
use dimos_core::trajectory::{JointTrajectory, JointValues, TrajectoryPoint};

/// Points closer together than this are merged [s].
const SAME_TIME: f64 = 1e-6;
/// Duration of the shortest motion [s], also of one to the present position.
const SHORTEST: f64 = 0.05;

/// Factor of the jerk for each further attempt if the generator finds nothing, and number of attempts.
const LESS_JERK: f64 = 0.999;
const LESS_JERK_TRIES: usize = 3;

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
    /// The generator found no motion.
    #[error("no motion found: {0}")]
    NotFound(String),
}

/// Returns the fastest motion from `start` to `target` [rad] with `speed` (0–1] times the joints' velocities, and
/// accelerations and jerks scaled to match (`speed²`, `speed³`), so that it is the same motion, slower. `start`,
/// `target` and `limits` have a value for each joint.
#[allow(clippy::indexing_slicing, reason = "a value for each joint; not on the tick's path")]
pub fn point_to_point(
    joints: &[String],
    start: &[f64],
    target: &[f64],
    limits: &JointLimits,
    speed: f64,
) -> Result<JointTrajectory, MotionError> {
    let n = joints.len();
    for (j, joint) in joints.iter().enumerate() {
        let bounds = super::limit::Bounds::inside(limits.position_lower[j], limits.position_upper[j], 1.0, 1.0);
        // A joint that starts outside its limits may stay or move in.
        let (lower, upper) = (bounds.lower.min(start[j]), bounds.upper.max(start[j]));
        let excess = (lower - target[j]).max(target[j] - upper);
        if excess.is_nan() || excess > 1e-9 {
            return Err(MotionError::OutOfLimits { joint: joint.clone(), target: target[j], lower, upper, excess });
        }
    }
    let mut input = InputParameter::<0>::new(Some(n));
    // A straight line in joint space, if the limits allow one: the expected path of a direct motion.
    input.synchronization = Synchronization::Phase;
    for j in 0..n {
        input.current_position[j] = start[j];
        input.target_position[j] = target[j];
        input.max_velocity[j] = limits.velocity_max[j] * speed;
        input.max_acceleration[j] = limits.acceleration_max[j] * speed * speed;
        input.max_jerk[j] = limits.jerk_max[j] * speed.powi(3);
    }
    let mut generator = Ruckig::<0, ThrowErrorHandler>::new(Some(n), 0.01);
    let mut found = Trajectory::<0>::new(Some(n));
    // The generator finds nothing where a distance is exactly at the border between two shapes of profile, such as
    // 2 a³/j². A little less jerk is on one side of it.
    let mut result = generator.calculate(&input, &mut found);
    for _ in 0..LESS_JERK_TRIES {
        if result.is_ok() {
            break;
        }
        (0..n).for_each(|j| input.max_jerk[j] *= LESS_JERK);
        result = generator.calculate(&input, &mut found);
    }
    // The generator's message is a page of numbers; its first line names the error.
    let first_line = |e: String| e.split("\\n").next().unwrap_or_default().to_owned();
    result.map_err(|e| MotionError::NotFound(first_line(format!("{e:?}"))))?;
    let duration = found.get_duration();
    if duration < SHORTEST {
        return Ok(stay(joints, start, target));
    }
    let mut times = vec![0.0, duration];
    for profile in found.get_profiles().iter().flat_map(|section| section.iter()) {
        // Rest to rest has neither a brake nor an acceleration phase before the seven steps.
        times.extend(profile.t_sum.iter().filter(|t| **t < duration));
    }
    times.sort_by(f64::total_cmp);
    times.dedup_by(|a, b| (*a - *b).abs() < SAME_TIME);
    if let Some(last) = times.last_mut() {
        *last = duration;
    }
    let mut points = Vec::with_capacity(times.len());
    for time in times {
        let (mut p, mut v, mut a) = (array(n), array(n), array(n));
        found.at_time(time, &mut Some(&mut p), &mut Some(&mut v), &mut Some(&mut a), &mut None, &mut None);
        points.push(TrajectoryPoint {
            time_from_start: time,
            positions: p.iter().copied().collect(),
            velocities: v.iter().copied().collect(),
            accelerations: JointValues::new(),
        });
    }
    // The ends are exactly the requested positions, without rounding errors.
    for (point, exact) in [(0, start), (points.len() - 1, target)] {
        points[point].positions.copy_from_slice(exact);
        points[point].velocities.fill(0.0);
    }
    Ok(JointTrajectory { joint_names: joints.to_vec(), points })
}

fn array(n: usize) -> DataArrayOrVec<f64, 0> {
    DataArrayOrVec::new(Some(n), 0.0)
}

fn stay(joints: &[String], start: &[f64], target: &[f64]) -> JointTrajectory {
    let point = |time_from_start, positions: &[f64]| TrajectoryPoint {
        time_from_start,
        positions: positions.into(),
        velocities: JointValues::from_elem(0.0, joints.len()),
        accelerations: JointValues::new(),
    };
    JointTrajectory { joint_names: joints.to_vec(), points: vec![point(0.0, start), point(SHORTEST, target)] }
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
