//! Fewer points for a long trajectory: planners of Python dimos and ROS make 100 a second, and a request to the run
//! holds 1200 points of six joints.

use dimos_rpc::api::Point;

/// Largest distance of the curve from a point that is left out [rad]. On straight lines between points 10 ms apart, as
/// Python dimos takes them, a joint deviates more from its curve.
const TOLERANCE: f64 = 1e-5;
/// Largest number of points in a row that are left out.
const MAX_GAP: usize = 64;

/// Returns the points without those that the cubic curve through the others passes within the tolerance. Needs the
/// velocities of all points; without them it returns the points as they are.
pub fn thinned(points: Vec<Point>) -> Vec<Point> {
    if points.iter().any(|point| point.velocities.is_none()) {
        return points;
    }
    let mut kept = Vec::new();
    let mut at = 0;
    while at + 1 < points.len() {
        kept.push(at);
        let last = (at + 1 + MAX_GAP).min(points.len() - 1);
        let fits = |end: &usize| passes(&points[at..=*end]);
        at = (at + 2..=last).take_while(fits).last().unwrap_or(at + 1);
    }
    kept.push(at);
    let mut next = kept.into_iter().peekable();
    let is_kept = |(index, point)| (next.next_if_eq(&index).is_some()).then_some(point);
    points.into_iter().enumerate().filter_map(is_kept).collect()
}

/// Returns whether the cubic from the first to the last of these points passes all others.
fn passes(points: &[Point]) -> bool {
    let [first, inner @ .., last] = points else { return true };
    let duration = last.time_from_start - first.time_from_start;
    let velocity = |point: &Point, joint: usize| {
        point.velocities.as_ref().and_then(|velocities| velocities.get(joint).copied()).unwrap_or_default()
    };
    inner.iter().all(|point| {
        let s = (point.time_from_start - first.time_from_start) / duration;
        let (rest, back) = ((1.0 - s) * (1.0 - s), s * s);
        point.positions.iter().enumerate().all(|(joint, position)| {
            let ends = (first.positions.get(joint), last.positions.get(joint));
            let (Some(from), Some(to)) = ends else { return false };
            let (v0, v1) = (velocity(first, joint), velocity(last, joint));
            let curve = rest * (1.0 + 2.0 * s) * from
                + back * (3.0 - 2.0 * s) * to
                + duration * (rest * s * v0 - back * (1.0 - s) * v1);
            (curve - position).abs() <= TOLERANCE
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 60 s at 100 points per second.
    fn points(at: impl Fn(f64) -> (f64, f64)) -> Vec<Point> {
        let point = |index: usize| {
            let t = index as f64 * 0.01;
            let (position, velocity) = at(t);
            Point {
                time_from_start: t,
                positions: vec![position; 6],
                velocities: Some(vec![velocity; 6]),
                accelerations: None,
            }
        };
        (0..=6000).map(point).collect()
    }

    #[test]
    fn a_smooth_trajectory_fits_into_a_request_and_keeps_its_curve() {
        let given = points(|t| (0.8 * (0.7 * t).sin(), 0.56 * (0.7 * t).cos()));
        let thin = thinned(given.clone());
        assert!((2..1200).contains(&thin.len()), "{}", thin.len());
        assert_eq!((thin.first(), thin.last()), (given.first(), given.last()));
        // The run's own curve through the points that are left.
        let trajectory = dimos_core::trajectory::JointTrajectory {
            joint_names: vec!["a".into()],
            points: thin
                .iter()
                .map(|point| dimos_core::trajectory::TrajectoryPoint {
                    time_from_start: point.time_from_start,
                    positions: [point.positions[0]][..].into(),
                    velocities: [point.velocities.as_ref().unwrap()[0]][..].into(),
                    accelerations: Default::default(),
                })
                .collect(),
        };
        let spline = dimos_core::trajectory::Spline::new(&trajectory).unwrap();
        let mut cursor = dimos_core::trajectory::Cursor::default();
        for point in &given {
            let mut sample = [dimos_core::trajectory::Sample::default()];
            spline.sample(point.time_from_start, &mut cursor, &mut sample);
            assert!((sample[0].position - point.positions[0]).abs() < 1.1e-5, "at {} s", point.time_from_start);
        }
    }

    #[test]
    fn corners_stay() {
        let zigzag = points(|t| (if (t * 100.0).round() as i64 % 2 == 0 { 0.0 } else { 0.01 }, 0.0));
        assert_eq!(thinned(zigzag.clone()), zigzag);
        let without: Vec<Point> = zigzag.into_iter().map(|point| Point { velocities: None, ..point }).collect();
        assert_eq!(thinned(without.clone()), without);
        assert_eq!(thinned(Vec::new()), []);
    }
}
