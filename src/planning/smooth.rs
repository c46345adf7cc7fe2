//! Bounded jerk along a curve: `s(t)` averaged over a window of time.
//!
//! The average of a motion from rest to rest is one from rest to rest, along the same curve, longer by the window `W`;
//! its acceleration is `(ṡ(t) − ṡ(t − W)) / W`, so it has no jumps, and jerk is bounded by the jumps it had over `W`.

use crate::trajectory::TrajectoryPoint;

use super::blend::Curve;
use super::timing::{TimingError, slow_down};
use super::topp::{GridPoint, JointBound};
use super::verify::Excess;

/// Time between points [s]; short motions get more points.
const STEP: f64 = 0.01;
/// Points at least.
const POINTS: f64 = 64.0;

/// A curve's points at even times, within all bounds: of several windows, the one with the shortest motion.
pub(super) fn averaged(
    names: &[String],
    curve: &Curve,
    grid: &[GridPoint],
    bounds: &[JointBound],
) -> Result<(Vec<TrajectoryPoint>, Excess), TimingError> {
    let motion = Motion::new(grid);
    let window = bounds.iter().filter(|b| b.jerk.is_finite()).map(|b| b.acceleration / b.jerk).fold(0.0, f64::max);
    let mut best: Option<(Vec<TrajectoryPoint>, Excess)> = None;
    for factor in [1.0, 2.0] {
        let mut points = motion.points(names.len(), curve, window * factor);
        let excess = slow_down(names, &mut points, bounds)?;
        let duration = |p: &Vec<TrajectoryPoint>| p.last().map_or(f64::INFINITY, |p| p.time_from_start);
        if best.as_ref().is_none_or(|b| duration(&points) < duration(&b.0)) {
            best = Some((points, excess));
        }
    }
    best.ok_or(TimingError::NoMotion)
}

/// `s(t)` with its integral.
struct Motion<'a> {
    grid: &'a [GridPoint],
    /// ∫s dt up to each grid point.
    area: Vec<f64>,
}

impl<'a> Motion<'a> {
    fn new(grid: &'a [GridPoint]) -> Self {
        let mut area = vec![0.0];
        for pair in grid.windows(2) {
            let whole = area.last().copied().unwrap_or(0.0) + part(&pair[0], &pair[1], pair[1].time - pair[0].time).0;
            area.push(whole);
        }
        Self { grid, area }
    }

    fn end(&self) -> (f64, f64) {
        self.grid.last().map_or((0.0, 0.0), |g| (g.time, g.s))
    }

    /// ∫s dt, s and ṡ at a time; at rest before the start and after the end.
    fn at(&self, t: f64) -> (f64, f64, f64) {
        let (duration, length) = self.end();
        if t <= 0.0 {
            return (0.0, 0.0, 0.0);
        }
        if t >= duration {
            return (self.area.last().unwrap_or(&0.0) + length * (t - duration), length, 0.0);
        }
        let after = self.grid.partition_point(|g| g.time <= t).clamp(1, self.grid.len() - 1);
        let (a, b) = (&self.grid[after - 1], &self.grid[after]);
        let (area, s, speed) = part(a, b, t - a.time);
        (self.area[after - 1] + area, s, speed)
    }

    fn points(&self, dof: usize, curve: &Curve, window: f64) -> Vec<TrajectoryPoint> {
        let window = window.max(1e-6);
        let duration = self.end().0 + window;
        let count = (duration / STEP).ceil().max(POINTS) as usize;
        let point = |k: usize| {
            let t = duration * k as f64 / count as f64;
            let (now, before) = (self.at(t), self.at(t - window));
            let (s, v, a) = ((now.0 - before.0) / window, (now.1 - before.1) / window, (now.2 - before.2) / window);
            let (mut piece, mut at) = (0, s);
            while piece + 1 < curve.len() && at > curve[piece].length {
                at -= curve[piece].length;
                piece += 1;
            }
            let at = at.clamp(0.0, curve[piece].length);
            let jets = (0..dof).map(|j| curve[piece].at(j, at));
            let mut p = TrajectoryPoint { time_from_start: t, ..TrajectoryPoint::default() };
            for jet in jets {
                p.positions.push(jet.q);
                p.velocities.push(jet.d1 * v);
                p.accelerations.push(jet.d2 * v * v + jet.d1 * a);
            }
            p
        };
        (0..=count).map(point).collect()
    }
}

/// ∫s dt since grid point `a`, s and ṡ, a time after it, on the way to `b`: there s̈ is constant.
fn part(a: &GridPoint, b: &GridPoint, t: f64) -> (f64, f64, f64) {
    let step = b.s - a.s;
    let u = if step > 0.0 { 0.5 * (b.x - a.x) / step } else { 0.0 };
    let v = a.x.sqrt();
    (t * (a.s + t * (0.5 * v + t * u / 6.0)), a.s + t * (v + 0.5 * t * u), v + t * u)
}
