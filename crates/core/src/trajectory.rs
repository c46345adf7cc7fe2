//! Joint trajectories: as given, and as smooth curves that can be sampled in real time.
//!
//! Between two points the curve is quintic if both have velocity and acceleration, cubic if both have a velocity.
//! Missing velocities are chosen so that the curve is smooth, stays within the range of its neighbours and is at rest
//! at both ends (Fritsch and Carlson, "Monotone piecewise cubic interpolation", 1980).

use serde::{Deserialize, Serialize};
use smallvec::SmallVec;

/// Maximum duration of a trajectory from a client or a file [s].
pub const MAX_DURATION: f64 = 24.0 * 3600.0;

/// Maximum number of actions of a chunk, which a policy makes from one observation.
pub const MAX_ACTIONS: usize = 256;

/// A trajectory as clients send it and files store it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JointTrajectory {
    /// The joints that move, in the order of the points' values.
    pub joint_names: Vec<String>,
    /// The points; times strictly increase from 0.
    pub points: Vec<TrajectoryPoint>,
}

/// One number per joint. Up to eight are kept without an allocation: a plan has hundreds of points.
pub type JointValues = SmallVec<[f64; 8]>;

/// One point of a trajectory.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrajectoryPoint {
    /// Time since the start of the trajectory [s].
    pub time_from_start: f64,
    /// Joint positions [rad].
    pub positions: JointValues,
    /// Joint velocities [rad/s]; empty if not given.
    #[serde(default, skip_serializing_if = "SmallVec::is_empty")]
    pub velocities: JointValues,
    /// Joint accelerations [rad/s²]; empty if not given.
    #[serde(default, skip_serializing_if = "SmallVec::is_empty")]
    pub accelerations: JointValues,
}

/// Why a trajectory is not valid.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum TrajectoryError {
    /// The list of joints is empty.
    #[error("the trajectory names no joints")]
    NoJoints,
    /// A joint is listed twice.
    #[error("joint {0:?} is named twice")]
    DuplicateJoint(String),
    /// Fewer than two points.
    #[error("the trajectory has {}; a motion needs at least 2", if *.0 == 1 { "1 point" } else { "no points" })]
    TooFewPoints(usize),
    /// A point has the wrong number of values.
    #[error("point {point}: {given} {what} for {joints} joints")]
    Width {
        /// Index of the point.
        point: usize,
        /// Which of its values.
        what: &'static str,
        /// Number of values.
        given: usize,
        /// Required number of values.
        joints: usize,
    },
    /// A value is NaN or infinite.
    #[error("point {point}: {what} of joint {joint:?} is not finite")]
    NotFinite {
        /// Index of the point.
        point: usize,
        /// Which of its values.
        what: &'static str,
        /// Which joint.
        joint: String,
    },
    /// Times do not start at zero or do not increase.
    #[error("point {point}: time {time} s {problem}")]
    Time {
        /// Index of the point.
        point: usize,
        /// Its time [s].
        time: f64,
        /// The problem.
        problem: &'static str,
    },
}

impl JointTrajectory {
    /// Checks shape, order of times and finiteness.
    pub fn validate(&self) -> Result<(), TrajectoryError> {
        let n = self.joint_names.len();
        if n == 0 {
            return Err(TrajectoryError::NoJoints);
        }
        for (i, name) in self.joint_names.iter().enumerate() {
            if self.joint_names[..i].contains(name) {
                return Err(TrajectoryError::DuplicateJoint(name.clone()));
            }
        }
        if self.points.len() < 2 {
            return Err(TrajectoryError::TooFewPoints(self.points.len()));
        }
        let mut last = None;
        for (point, p) in self.points.iter().enumerate() {
            let problem = match last {
                _ if !p.time_from_start.is_finite() => Some("is not finite"),
                None if p.time_from_start != 0.0 => Some("should be 0: the first point is the start"),
                Some(t) if p.time_from_start <= t => Some("is not later than that of the previous point"),
                _ => None,
            };
            if let Some(problem) = problem {
                return Err(TrajectoryError::Time { point, time: p.time_from_start, problem });
            }
            last = Some(p.time_from_start);
            self.validate_values(point, "positions", &p.positions, false)?;
            self.validate_values(point, "velocities", &p.velocities, true)?;
            self.validate_values(point, "accelerations", &p.accelerations, true)?;
        }
        Ok(())
    }

    fn validate_values(
        &self,
        point: usize,
        what: &'static str,
        values: &[f64],
        may_be_empty: bool,
    ) -> Result<(), TrajectoryError> {
        let joints = self.joint_names.len();
        if values.len() != joints && !(may_be_empty && values.is_empty()) {
            return Err(TrajectoryError::Width { point, what, given: values.len(), joints });
        }
        match values.iter().position(|v| !v.is_finite()) {
            Some(j) => Err(TrajectoryError::NotFinite { point, what, joint: self.joint_names[j].clone() }),
            None => Ok(()),
        }
    }

    /// Returns the duration [s].
    pub fn duration(&self) -> f64 {
        self.points.last().map_or(0.0, |p| p.time_from_start)
    }

    /// Returns the same path at `speed` times the speed (0–1].
    pub fn scaled(&self, speed: f64) -> Self {
        let mut scaled = self.clone();
        for p in &mut scaled.points {
            p.time_from_start /= speed;
            p.velocities.iter_mut().for_each(|v| *v *= speed);
            p.accelerations.iter_mut().for_each(|a| *a *= speed * speed);
        }
        scaled
    }
}

/// Position, velocity and acceleration of one joint at one time.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Sample {
    /// [rad]
    pub position: f64,
    /// [rad/s]
    pub velocity: f64,
    /// [rad/s²]
    pub acceleration: f64,
}

/// A trajectory as one polynomial per joint and segment; sampling does not allocate.
#[derive(Debug, Clone, PartialEq)]
pub struct Spline {
    joints: usize,
    times: Vec<f64>,
    /// Coefficients in ascending powers of the time in the segment, segment by segment, joint by joint.
    coefficients: Vec<[f64; 6]>,
}

/// Remembers the segment of the last sample for fast lookup.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Cursor(usize);

impl Spline {
    /// Builds the curve through a trajectory's points.
    pub fn new(trajectory: &JointTrajectory) -> Result<Self, TrajectoryError> {
        trajectory.validate()?;
        let joints = trajectory.joint_names.len();
        let points = &trajectory.points;
        let times: Vec<f64> = points.iter().map(|p| p.time_from_start).collect();
        let mut coefficients = vec![[0.0; 6]; (points.len() - 1) * joints];
        for j in 0..joints {
            let velocities = velocities_of(trajectory, &times, j);
            for (s, pair) in points.windows(2).enumerate() {
                let (a, b) = (&pair[0], &pair[1]);
                let h = times[s + 1] - times[s];
                let ends = (a.positions[j], b.positions[j], velocities[s], velocities[s + 1]);
                let stated = !a.velocities.is_empty() && !b.velocities.is_empty();
                let curve = match (a.accelerations.get(j), b.accelerations.get(j)) {
                    (Some(&a0), Some(&a1)) if stated => quintic(ends, a0, a1, h),
                    _ => cubic(ends, h),
                };
                let reach = curve.iter().rev().fold(0.0, |sum, c| sum * h + c.abs());
                if !curve.iter().all(|c| c.is_finite()) || !reach.is_finite() {
                    let problem = "is too close to the previous point for the change between them";
                    return Err(TrajectoryError::Time { point: s + 1, time: times[s + 1], problem });
                }
                coefficients[s * joints + j] = curve;
            }
        }
        Ok(Self { joints, times, coefficients })
    }

    /// Returns the number of joints.
    pub fn joints(&self) -> usize {
        self.joints
    }

    /// Returns the duration [s].
    pub fn duration(&self) -> f64 {
        self.times.last().copied().unwrap_or(0.0)
    }

    /// Returns the times of the points [s].
    pub fn times(&self) -> &[f64] {
        &self.times
    }

    /// Computes one sample per joint at time `t` [s since the start]; outside its duration the arm is at rest at the
    /// first or last point.
    pub fn sample(&self, t: f64, cursor: &mut Cursor, out: &mut [Sample]) {
        let last = self.times.len().saturating_sub(2);
        let mut s = cursor.0.min(last);
        while s < last && self.times.get(s + 1).is_some_and(|&end| t >= end) {
            s += 1;
        }
        while s > 0 && self.times.get(s).is_some_and(|&start| t < start) {
            s -= 1;
        }
        *cursor = Cursor(s);
        let start = self.times.get(s).copied().unwrap_or(0.0);
        let length = self.times.get(s + 1).copied().unwrap_or(start) - start;
        let at = t - start;
        let rests = at < 0.0 || at > length;
        let x = at.clamp(0.0, length);
        let segment = self.coefficients.get(s * self.joints..(s + 1) * self.joints).unwrap_or_default();
        for (c, o) in segment.iter().zip(out.iter_mut()) {
            *o = evaluate(c, x);
            if rests {
                o.velocity = 0.0;
                o.acceleration = 0.0;
            }
        }
    }

    /// Returns the position of a joint at the start [rad]; NaN for a joint that does not exist.
    pub fn start(&self, joint: usize) -> f64 {
        self.coefficients.get(..self.joints).and_then(|first| first.get(joint)).map_or(f64::NAN, |c| c[0])
    }

    /// Returns the position of a joint at the end [rad]; NaN for a joint that does not exist.
    pub fn goal(&self, joint: usize) -> f64 {
        let segment = self.coefficients.len().saturating_sub(self.joints);
        let length = self.times.windows(2).last().map_or(0.0, |t| t[1] - t[0]);
        let last = self.coefficients.get(segment..).and_then(|last| last.get(joint));
        last.map_or(f64::NAN, |c| evaluate(c, length).position)
    }

    /// Returns the largest |velocity| and |acceleration| and the range of positions of one joint: where a derivative
    /// changes its sign between 33 places of each segment, bisected to rounding.
    pub fn extremes(&self, joint: usize) -> Extremes {
        let mut e = Extremes { lowest: f64::MAX, highest: f64::MIN, fastest: 0.0, steepest: 0.0 };
        for (s, pair) in self.times.windows(2).enumerate() {
            let Some(c) = self.coefficients.get(s * self.joints + joint) else { continue };
            let at = |k: i32| (pair[1] - pair[0]) * f64::from(k) / f64::from(PLACES);
            let mut add = |x: f64| {
                let p = evaluate(c, x);
                e.lowest = e.lowest.min(p.position);
                e.highest = e.highest.max(p.position);
                e.fastest = e.fastest.max(p.velocity.abs());
                e.steepest = e.steepest.max(p.acceleration.abs());
            };
            add(0.0);
            for k in 1..=PLACES {
                let (from, to) = (at(k - 1), at(k));
                let derivatives: [Derivative; 3] =
                    [|c, x| evaluate(c, x).velocity, |c, x| evaluate(c, x).acceleration, jerk];
                for derivative in derivatives {
                    if let Some(x) = sign_change(|x| derivative(c, x), from, to) {
                        add(x);
                    }
                }
                add(to);
            }
        }
        e
    }
}

/// Places of a segment between which its extremes are searched.
const PLACES: i32 = 32;
/// Halvings of a thirty-second of a segment: to the precision of its numbers.
const HALVINGS: u32 = 48;

/// A derivative of a segment.
type Derivative = fn(&[f64; 6], f64) -> f64;

/// Returns the jerk of a segment [rad/s³].
fn jerk(c: &[f64; 6], x: f64) -> f64 {
    6.0 * c[3] + x * (24.0 * c[4] + x * 60.0 * c[5])
}

/// Returns where a function changes its sign between two places; `None` if both have the same.
fn sign_change(f: impl Fn(f64) -> f64, mut from: f64, mut to: f64) -> Option<f64> {
    let before = f(from) < 0.0;
    if before == (f(to) < 0.0) {
        return None;
    }
    for _ in 0..HALVINGS {
        let middle = 0.5 * (from + to);
        if (f(middle) < 0.0) == before { from = middle } else { to = middle }
    }
    Some(to)
}

/// Range of a joint's motion along a trajectory.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Extremes {
    /// Lowest position [rad].
    pub lowest: f64,
    /// Highest position [rad].
    pub highest: f64,
    /// Maximum speed [rad/s].
    pub fastest: f64,
    /// Maximum acceleration magnitude [rad/s²].
    pub steepest: f64,
}

fn evaluate(c: &[f64; 6], x: f64) -> Sample {
    let [c0, c1, c2, c3, c4, c5] = *c;
    Sample {
        position: c0 + x * (c1 + x * (c2 + x * (c3 + x * (c4 + x * c5)))),
        velocity: c1 + x * (2.0 * c2 + x * (3.0 * c3 + x * (4.0 * c4 + x * 5.0 * c5))),
        acceleration: 2.0 * c2 + x * (6.0 * c3 + x * (12.0 * c4 + x * 20.0 * c5)),
    }
}

/// Cubic Hermite polynomial through (p0, v0) at 0 and (p1, v1) at h.
fn cubic((p0, p1, v0, v1): (f64, f64, f64, f64), h: f64) -> [f64; 6] {
    let d = (p1 - p0) / h;
    [p0, v0, (3.0 * d - 2.0 * v0 - v1) / h, (v0 + v1 - 2.0 * d) / (h * h), 0.0, 0.0]
}

/// Quintic Hermite polynomial through (p0, v0, a0) at 0 and (p1, v1, a1) at h.
fn quintic((p0, p1, v0, v1): (f64, f64, f64, f64), a0: f64, a1: f64, h: f64) -> [f64; 6] {
    let d = p1 - p0;
    let (h2, h3) = (h * h, h * h * h);
    [
        p0,
        v0,
        a0 / 2.0,
        (20.0 * d - (8.0 * v1 + 12.0 * v0) * h - (3.0 * a0 - a1) * h2) / (2.0 * h3),
        (-30.0 * d + (14.0 * v1 + 16.0 * v0) * h + (3.0 * a0 - 2.0 * a1) * h2) / (2.0 * h3 * h),
        (12.0 * d - 6.0 * (v1 + v0) * h + (a1 - a0) * h2) / (2.0 * h3 * h2),
    ]
}

/// Returns a quintic step from 0 to 1 with zero velocity and acceleration at both ends; constant outside of 0 to 1.
pub fn smooth_step(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * x * (10.0 + x * (6.0 * x - 15.0))
}

/// Returns the velocities of one joint at the points: those given, otherwise the monotone choice.
fn velocities_of(trajectory: &JointTrajectory, times: &[f64], j: usize) -> Vec<f64> {
    let points = &trajectory.points;
    let slope = |s: usize| (points[s + 1].positions[j] - points[s].positions[j]) / (times[s + 1] - times[s]);
    (0..points.len())
        .map(|k| match points[k].velocities.get(j) {
            Some(&v) => v,
            None if k == 0 || k + 1 == points.len() => 0.0,
            None => {
                let (before, after) = (slope(k - 1), slope(k));
                if before * after <= 0.0 {
                    return 0.0;
                }
                let (h0, h1) = (times[k] - times[k - 1], times[k + 1] - times[k]);
                let (w0, w1) = (2.0 * h1 + h0, h1 + 2.0 * h0);
                (w0 + w1) / (w0 / before + w1 / after)
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(t: f64, p: &[f64], v: &[f64], a: &[f64]) -> TrajectoryPoint {
        TrajectoryPoint { time_from_start: t, positions: p.into(), velocities: v.into(), accelerations: a.into() }
    }

    fn trajectory(points: Vec<TrajectoryPoint>) -> JointTrajectory {
        JointTrajectory { joint_names: (0..points[0].positions.len()).map(|i| format!("j{i}")).collect(), points }
    }

    fn at(s: &Spline, t: f64) -> Sample {
        let mut out = vec![Sample::default(); s.joints()];
        s.sample(t, &mut Cursor::default(), &mut out);
        out[0]
    }

    #[test]
    fn a_quintic_meets_position_velocity_and_acceleration_at_both_ends() {
        let t = trajectory(vec![point(0.0, &[1.0], &[0.5], &[-0.25]), point(2.0, &[3.0], &[-1.0], &[0.75])]);
        let s = Spline::new(&t).unwrap();
        for (time, p) in [(0.0, 0), (2.0, 1)] {
            let got = at(&s, time);
            assert!((got.position - t.points[p].positions[0]).abs() < 1e-12);
            assert!((got.velocity - t.points[p].velocities[0]).abs() < 1e-12);
            assert!((got.acceleration - t.points[p].accelerations[0]).abs() < 1e-12);
        }
    }

    #[test]
    fn velocities_are_used_and_continuous_across_points() {
        let t = trajectory(vec![
            point(0.0, &[0.0], &[0.0], &[]),
            point(1.0, &[1.0], &[1.5], &[]),
            point(2.0, &[2.0], &[0.0], &[]),
        ]);
        let s = Spline::new(&t).unwrap();
        assert!((at(&s, 1.0 - 1e-9).velocity - 1.5).abs() < 1e-6);
        assert!((at(&s, 1.0 + 1e-9).velocity - 1.5).abs() < 1e-6);
    }

    #[test]
    fn missing_velocities_never_overshoot_and_rest_at_the_ends() {
        let t = trajectory(vec![
            point(0.0, &[0.0], &[], &[]),
            point(1.0, &[1.0], &[], &[]),
            point(1.5, &[1.0], &[], &[]),
            point(3.0, &[-1.0], &[], &[]),
        ]);
        let s = Spline::new(&t).unwrap();
        let e = s.extremes(0);
        assert!(e.lowest >= -1.0 - 1e-12 && e.highest <= 1.0 + 1e-12, "{e:?}");
        assert_eq!(at(&s, 0.0).velocity, 0.0);
        assert_eq!(at(&s, 3.0).velocity, 0.0);
    }

    #[test]
    fn outside_its_time_it_rests_at_its_ends() {
        let t = trajectory(vec![point(0.0, &[0.0], &[1.0], &[]), point(1.0, &[1.0], &[1.0], &[])]);
        let s = Spline::new(&t).unwrap();
        assert_eq!(at(&s, -1.0), Sample { position: 0.0, velocity: 0.0, acceleration: 0.0 });
        let after = at(&s, 7.0);
        assert!((after.position - 1.0).abs() < 1e-12 && after.velocity == 0.0);
        assert!((s.goal(0) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn a_cursor_gives_what_a_fresh_search_gives() {
        let points = (0..50).map(|i| point(i as f64 * 0.1, &[(i as f64).sin()], &[], &[])).collect();
        let s = Spline::new(&trajectory(points)).unwrap();
        let (mut cursor, mut out) = (Cursor::default(), [Sample::default()]);
        for k in [0, 3, 7, 200, 480, 100, 490, 0] {
            s.sample(k as f64 * 0.01, &mut cursor, &mut out);
            assert_eq!(out[0], at(&s, k as f64 * 0.01));
        }
    }

    #[test]
    fn errors_are_reported() {
        let one = trajectory(vec![point(0.0, &[0.0], &[], &[])]);
        assert_eq!(one.validate(), Err(TrajectoryError::TooFewPoints(1)));
        let late = trajectory(vec![point(0.5, &[0.0], &[], &[]), point(1.0, &[0.0], &[], &[])]);
        assert!(matches!(late.validate(), Err(TrajectoryError::Time { point: 0, .. })));
        let back = trajectory(vec![point(0.0, &[0.0], &[], &[]), point(0.0, &[0.0], &[], &[])]);
        assert!(matches!(back.validate(), Err(TrajectoryError::Time { point: 1, .. })));
        let nan = trajectory(vec![point(0.0, &[0.0], &[], &[]), point(1.0, &[f64::NAN], &[], &[])]);
        assert!(matches!(nan.validate(), Err(TrajectoryError::NotFinite { point: 1, .. })));
        let wide = trajectory(vec![point(0.0, &[0.0], &[], &[]), point(1.0, &[0.0], &[0.0, 1.0], &[])]);
        assert!(matches!(wide.validate(), Err(TrajectoryError::Width { point: 1, given: 2, .. })));
    }
}
