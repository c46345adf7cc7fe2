//! Fits a curve to commands recorded per tick, with no higher velocity or acceleration than theirs.
//!
//! The commands are the control points of a quadratic B-spline: its velocity is piecewise linear through the
//! differences of the commands, so velocity and acceleration stay within the commanded ones, and the curve deviates
//! from each command by an eighth of its second difference (0.025 mrad at 2 rad/s² and 100 Hz). Between the middles of
//! two ticks it is a parabola, which points with positions and velocities reproduce exactly. Points that a cubic
//! between their neighbours reproduces are left out.

use super::motion::RecordedMotion;
use dimos_core::trajectory::{JointTrajectory, JointValues, TrajectoryPoint};

/// Maximum deviation from leaving out a point [rad].
const TOLERANCE: f64 = 5e-7;
/// Relative excess of velocity or acceleration allowed by leaving out points.
const SLACK: f64 = 1e-4;
/// Maximum number of ticks between two points.
const MAX_TICKS: usize = 4096;

/// Returns the curve, from rest to rest.
pub fn fit(motion: &RecordedMotion) -> JointTrajectory {
    let (rows, dt) = (&motion.rows, motion.period);
    let mut knots = Vec::with_capacity(rows.len() + 1);
    let (Some(first), Some(last)) = (rows.first(), rows.last()) else {
        return JointTrajectory { joint_names: motion.joints.clone(), points: Vec::new() };
    };
    let rest = |row: &Vec<f64>| Knot { positions: row.clone(), velocities: vec![0.0; row.len()] };
    knots.push(rest(first));
    for pair in rows.windows(2) {
        let both = || pair[0].iter().zip(&pair[1]);
        knots.push(Knot {
            positions: both().map(|(a, b)| if a == b { *a } else { 0.5 * (a + b) }).collect(),
            velocities: both().map(|(a, b)| (b - a) / dt).collect(),
        });
    }
    knots.push(rest(last));
    let points = needed(&knots, dt).into_iter().map(|k| TrajectoryPoint {
        time_from_start: k as f64 * dt,
        positions: knots[k].positions[..].into(),
        velocities: knots[k].velocities[..].into(),
        accelerations: JointValues::new(),
    });
    JointTrajectory { joint_names: motion.joints.clone(), points: points.collect() }
}

struct Knot {
    positions: Vec<f64>,
    velocities: Vec<f64>,
}

/// Returns the knots that the curve needs: each as far from the previous one as possible.
fn needed(knots: &[Knot], dt: f64) -> Vec<usize> {
    let mut kept = vec![0];
    let mut a = 0;
    while a + 1 < knots.len() {
        let furthest = (knots.len() - 1).min(a + MAX_TICKS);
        // In steps that double, then bisection: a span that is reproduced nearly always means that shorter ones are
        // too.
        let (mut good, mut step) = (a + 1, 2);
        while a + step <= furthest && is_reproduced(knots, a, a + step, dt) {
            good = a + step;
            step *= 2;
        }
        let mut bad = (a + step).min(furthest + 1);
        while good + 1 < bad {
            let middle = good.midpoint(bad);
            if is_reproduced(knots, a, middle, dt) { good = middle } else { bad = middle }
        }
        kept.push(good);
        a = good;
    }
    kept
}

/// Returns whether one cubic from knot `a` to knot `b` reproduces all between them, for every joint.
fn is_reproduced(knots: &[Knot], a: usize, b: usize, dt: f64) -> bool {
    let h = (b - a) as f64 * dt;
    (0..knots[a].positions.len()).all(|j| {
        let (p0, v0, p1, v1) =
            (knots[a].positions[j], knots[a].velocities[j], knots[b].positions[j], knots[b].velocities[j]);
        let d = (p1 - p0) / h;
        let (c2, c3) = ((3.0 * d - 2.0 * v0 - v1) / h, (v0 + v1 - 2.0 * d) / (h * h));
        let (mut fastest, mut steepest) = (v0.abs().max(v1.abs()), 0.0f64);
        for k in a..b {
            let (x, knot, next) = ((k - a) as f64 * dt, &knots[k], &knots[k + 1]);
            if (p0 + x * (v0 + x * (c2 + x * c3)) - knot.positions[j]).abs() > TOLERANCE {
                return false;
            }
            fastest = fastest.max(knot.velocities[j].abs());
            steepest = steepest.max((next.velocities[j] - knot.velocities[j]).abs() / dt);
        }
        let (a0, a1) = (2.0 * c2, 2.0 * c2 + 6.0 * c3 * h);
        // Where the acceleration changes sign, the velocity has its peak.
        let peak = if a0 * a1 < 0.0 { v0 - 0.5 * a0 * a0 * h / (a1 - a0) } else { 0.0 };
        let within = |value: f64, most: f64| value.abs() <= most * (1.0 + SLACK) + 1e-9;
        within(a0, steepest) && within(a1, steepest) && within(peak, fastest)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_control::limit::Limiter;
    use dimos_control::point_to_point::point_to_point;
    use dimos_core::joint::{JointBounds, JointLimits, make_joints};
    use dimos_core::trajectory::{Cursor, Sample, Spline};

    const DT: f64 = 0.01;

    fn motion(rows: Vec<Vec<f64>>) -> RecordedMotion {
        RecordedMotion {
            joints: make_joints("arm", rows[0].len()),
            period: DT,
            rows,
            last: 0,
            lost: 0,
            grips: Vec::new(),
        }
    }

    /// Returns the largest distance between the curve and the commands.
    fn distance(spline: &Spline, rows: &[Vec<f64>]) -> f64 {
        let mut out = vec![Sample::default(); spline.joints()];
        let mut cursor = Cursor::default();
        let mut furthest = 0.0f64;
        for (k, row) in rows.iter().enumerate() {
            // The middle between the knots before and after a tick.
            spline.sample((k as f64 + 0.5) * DT, &mut cursor, &mut out);
            furthest = out.iter().zip(row).map(|(s, q)| (s.position - q).abs()).fold(furthest, f64::max);
        }
        furthest
    }

    /// A motion within a limiter's limits stays within them as a curve.
    #[test]
    fn a_motion_within_limits_makes_a_curve_within_limits() {
        let (velocity, acceleration) = (1.5, 4.0);
        let mut limiter = Limiter::new(JointBounds::inside(-2.0, 2.0, velocity, acceleration));
        let mut rows = vec![vec![0.0]; 5];
        for k in 0..600 {
            let target = [0.15, -0.02, 0.09, 0.12][k / 40 % 4] + 0.05 * (k as f64 * 0.3).sin();
            let q = limiter.follow_position(target, DT, 1.0).map_or_else(|_| limiter.hold_position(DT), |l| l.value);
            rows.push(vec![q]);
        }
        for _ in 0..100 {
            rows.push(vec![limiter.hold_position(DT)]);
        }
        let spline = Spline::new(&fit(&motion(rows.clone()))).unwrap();
        let e = spline.extremes(0);
        assert!(e.fastest <= velocity * 1.001 && e.steepest <= acceleration * 1.001, "{e:?}");
        assert!(e.steepest > 0.9 * acceleration, "it is a hard motion");
        let off = distance(&spline, &rows);
        assert!(off <= acceleration * DT * DT / 8.0 + 1e-6, "{off}");
        assert_eq!((spline.start(0), spline.goal(0)), (0.0, *rows.last().unwrap().last().unwrap()));
    }

    #[test]
    fn a_move_needs_few_points() {
        let limits = JointLimits::uniform(3, 3.0, 2.0).with_defaults();
        let names = make_joints("arm", 3);
        let path = point_to_point(&names, &[0.0; 3], &[0.7, -0.3, 0.5], &limits, 0.8).unwrap();
        let spline = Spline::new(&path).unwrap();
        let mut out = [Sample::default(); 3];
        let rows: Vec<Vec<f64>> = (0..1000)
            .map(|k| {
                spline.sample(k as f64 * DT - 2.0, &mut Cursor::default(), &mut out);
                out.iter().map(|s| s.position).collect()
            })
            .collect();
        let fitted = fit(&motion(rows.clone()));
        assert!(fitted.points.len() < 60, "{} points for 1000 ticks", fitted.points.len());
        let fitted = Spline::new(&fitted).unwrap();
        for j in 0..3 {
            let (is, was) = (fitted.extremes(j), spline.extremes(j));
            assert!(is.fastest <= was.fastest * 1.001 && is.steepest <= was.steepest * 1.001, "{is:?} {was:?}");
        }
        assert!(distance(&fitted, &rows) < 3e-5);
    }
}
