//! Time-optimal motion along a curve within velocity and acceleration limits: time-optimal path parameterization by
//! reachability analysis (Pham and Pham, "A new approach to time-optimal path parameterization based on reachability
//! analysis", 2018), on a grid along the curve.
//!
//! At each grid point `x = ṡ²` and `u = s̈` must keep `|q'·u + q''·x| ≤ a` for every joint, here and at the next point,
//! because `u` is constant in between. Backward pass: the highest `x` from which rest is reachable. Forward pass: the
//! highest `u` that stays below it.

use super::blend::{Curve, Piece};
use dimos_core::joint::JointBounds;

/// A grid point: position on the curve, and speed.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GridPoint {
    /// Index of the piece.
    pub piece: usize,
    /// Parameter from the piece's start [rad].
    pub at: f64,
    /// Parameter from the curve's start [rad].
    pub s: f64,
    /// Squared speed of the parameter [rad²/s²].
    pub x: f64,
    /// Time from the curve's start [s].
    pub time: f64,
}

/// Part of the limits that a piece may use, 0–1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::planning) struct Pace {
    /// Part of the maximum `x`.
    pub x: f64,
    /// Part of the acceleration limits.
    pub acceleration: f64,
}

impl Pace {
    /// The full limits.
    pub const FULL: Self = Self { x: 1.0, acceleration: 1.0 };
}

/// Returns the grid of a curve with speeds and times, from rest to rest; a corner has `intervals` of it.
pub fn parameterize(curve: &Curve, bounds: &[JointBounds], intervals: usize) -> Vec<GridPoint> {
    let (constraints, speed_grid) = speed_grid(curve, bounds, intervals);
    let paces = vec![Pace::FULL; curve.len()];
    let speeds = speed_grid.fastest(&constraints, &paces);
    speed_grid.timed(&speeds, &paces)
}

/// A constraint: `u` stays within `width` of `slope·x`.
#[derive(Debug, Clone, Copy)]
pub(in crate::planning) struct Constraint {
    slope: f64,
    width: f64,
}

/// An interval of the grid.
#[derive(Debug, Clone, Copy)]
enum Interval {
    /// A line, with the maximum `u` and `x` on it.
    Line { push: f64, most: f64 },
    /// A part of a corner, with the index of its first constraint and one past its last.
    Corner { first: usize, end: usize },
}

/// The grid along a curve.
#[derive(Debug, Clone, Default)]
pub(in crate::planning) struct SpeedGrid {
    /// Grid points, with the maximum `x` at each.
    points: Vec<GridPoint>,
    /// The interval from each point to the next.
    intervals: Vec<Interval>,
}

/// Returns the grid along a curve, and the constraints on `u` in its corners, of `each` intervals.
pub(in crate::planning) fn speed_grid(
    curve: &Curve,
    bounds: &[JointBounds],
    each: usize,
) -> (Vec<Constraint>, SpeedGrid) {
    let corners = curve.iter().filter(|piece| piece.bends).count();
    let intervals = corners * each + curve.len() - corners;
    let mut constraints = Vec::with_capacity(corners * each * bounds.len() * 2);
    let mut speed_grid =
        SpeedGrid { points: Vec::with_capacity(intervals + 1), intervals: Vec::with_capacity(intervals) };
    let mut start = 0.0;
    for (p, piece) in curve.iter().enumerate() {
        let entry = highest(piece, 0.0, bounds);
        match speed_grid.points.last_mut() {
            Some(point) => point.x = point.x.min(entry),
            None => speed_grid.points.push(GridPoint { x: entry, ..GridPoint::default() }),
        }
        if piece.bends {
            speed_grid.add_corner((p, piece, start), bounds, each, &mut constraints);
        } else {
            let (at, most) = (piece.length, fastest(piece, bounds));
            speed_grid.intervals.push(Interval::Line { push: hardest(piece, bounds), most });
            speed_grid.points.push(GridPoint { piece: p, at, s: start + at, x: most, time: 0.0 });
        }
        start += piece.length;
    }
    (constraints, speed_grid)
}

impl SpeedGrid {
    fn add_corner(
        &mut self,
        (p, piece, start): (usize, &Piece, f64),
        bounds: &[JointBounds],
        intervals: usize,
        constraints: &mut Vec<Constraint>,
    ) {
        let step = piece.length / intervals as f64;
        let mut here = piece.progress(0.0);
        for k in 1..=intervals {
            let at = step * k as f64;
            let there = piece.progress(at);
            let first = constraints.len();
            for ((direction, turn), bound) in piece.direction.iter().zip(&piece.turn).zip(bounds) {
                // q'·u + q''·x here; q'·u + q''·(x + 2·step·u) there.
                let ahead = turn * there.d1;
                for (a, b) in [
                    (direction + turn * here.part, turn * here.d1),
                    (direction + turn * there.part + 2.0 * step * ahead, ahead),
                ] {
                    if a.abs() >= 1e-9 {
                        let inverse = 1.0 / a;
                        constraints.push(Constraint { slope: -b * inverse, width: bound.acceleration * inverse.abs() });
                    }
                }
            }
            self.intervals.push(Interval::Corner { first, end: constraints.len() });
            let x = highest(piece, at, bounds);
            self.points.push(GridPoint { piece: p, at, s: start + at, x, time: 0.0 });
            here = there;
        }
    }

    /// Returns the maximum `x` at each point with each piece at its pace, from rest to rest.
    pub fn fastest(&self, constraints: &[Constraint], paces: &[Pace]) -> Vec<f64> {
        let (points, n) = (&self.points, self.points.len());
        let mut speeds = vec![0.0; n];
        // Backward pass: from where the next point is reachable.
        for i in (1..n - 1).rev() {
            let (step, next) = (points[i + 1].s - points[i].s, speeds[i + 1]);
            let pace = paces[points[i + 1].piece];
            // The first point of a piece is the last one of the previous piece.
            let most = points[i].x * pace.x.min(paces[points[i].piece].x);
            speeds[i] = match self.intervals[i] {
                Interval::Line { push, .. } => most.min(next + 2.0 * step * push * pace.acceleration),
                Interval::Corner { first, end } => {
                    controllable(&constraints[first..end], pace.acceleration, step, most, next)
                }
            };
        }
        // Forward pass: as fast as possible, up to that.
        let mut x: f64 = 0.0;
        for (i, way) in self.intervals.iter().enumerate() {
            let step = points[i + 1].s - points[i].s;
            let pace = paces[points[i + 1].piece].acceleration;
            let high = match *way {
                Interval::Line { push, .. } => push * pace,
                Interval::Corner { first, end } => accelerations(&constraints[first..end], pace, x).1.0,
            };
            x = (x + 2.0 * step * high).clamp(0.0, speeds[i + 1]);
            speeds[i + 1] = x;
        }
        speeds
    }

    /// Returns the points with these speeds and their times, plus the points on lines where acceleration ends and
    /// deceleration begins.
    pub fn timed(&self, speeds: &[f64], paces: &[Pace]) -> Vec<GridPoint> {
        let mut full: Vec<GridPoint> = Vec::with_capacity(3 * self.points.len());
        for (i, (point, &x)) in self.points.iter().zip(speeds).enumerate() {
            let to = GridPoint { x, ..*point };
            if let (Some(&from), Some(Interval::Line { push, most })) =
                (full.last(), self.intervals.get(i.wrapping_sub(1)))
            {
                let pace = paces[to.piece];
                switches(&from, &to, push * pace.acceleration, most * pace.x, &mut full);
            }
            full.push(to);
        }
        set_times(&mut full);
        full
    }
}

/// Computes the times of points from their speeds.
fn set_times(points: &mut [GridPoint]) {
    let mut last = GridPoint::default();
    for point in points {
        point.time = last.time;
        if point.s > last.s {
            point.time += (point.s - last.s) / (0.5 * (last.x.sqrt() + point.x.sqrt())).max(1e-9);
        }
        last = *point;
    }
}

/// Adds the points of a line where acceleration ends and deceleration begins.
fn switches(from: &GridPoint, to: &GridPoint, push: f64, fastest: f64, out: &mut Vec<GridPoint>) {
    let length = to.s - from.s;
    let peak = (0.5 * (from.x + to.x) + push * length).max(from.x).max(to.x).min(fastest);
    let (up, down) = ((peak - from.x) / (2.0 * push), (peak - to.x) / (2.0 * push));
    let mut add = |along: f64| {
        let last = out.last().map_or(from.s, |p| p.s);
        if along > 1e-9 && along < length - 1e-9 && from.s + along > last + 1e-9 {
            let at = to.at - length + along;
            out.push(GridPoint { piece: to.piece, at, s: from.s + along, x: peak, time: 0.0 });
        }
    };
    add(up);
    add(length - down);
}

/// Returns the maximum `u` on a line.
fn hardest(line: &Piece, bounds: &[JointBounds]) -> f64 {
    let u = line.direction.iter().zip(bounds).map(|(d1, b)| b.acceleration / d1.abs().max(1e-12));
    u.fold(f64::INFINITY, f64::min)
}

/// Returns the maximum `x` on a line.
fn fastest(line: &Piece, bounds: &[JointBounds]) -> f64 {
    let speed = line.direction.iter().zip(bounds).map(|(d1, b)| b.velocity / d1.abs().max(1e-12));
    speed.fold(f64::INFINITY, f64::min).powi(2)
}

/// Returns the maximum `x` at a point of a piece, from the joint speeds and from what no `u` can compensate.
fn highest(piece: &Piece, at: f64, bounds: &[JointBounds]) -> f64 {
    let t = piece.progress(at);
    let (mut speed, mut x, mut cube) = (f64::INFINITY, f64::INFINITY, f64::INFINITY);
    for ((direction, turn), bound) in piece.direction.iter().zip(&piece.turn).zip(bounds) {
        let d1 = (direction + turn * t.part).abs();
        speed = speed.min(bound.velocity / d1.max(1e-12));
        // Where a joint reverses, curvature uses all its acceleration.
        if d1 < 1e-6 {
            x = x.min(bound.acceleration / (turn * t.d1).abs().max(1e-12));
        }
        // The change of curvature uses jerk.
        cube = cube.min(0.5 * bound.jerk / (turn * t.d2).abs().max(1e-12));
    }
    if cube.is_finite() {
        speed = speed.min(cube.cbrt());
    }
    x.min(speed * speed)
}

/// A bound of `u` at some `x`, and its derivative with respect to `x`.
type Edge = (f64, f64);

/// Returns the lowest and highest `u` at `x` that keep all acceleration limits, here and one step on; the lowest
/// exceeds the highest if there is none.
fn accelerations(constraints: &[Constraint], pace: f64, x: f64) -> (Edge, Edge) {
    let (mut low, mut high) = ((f64::NEG_INFINITY, 0.0), (f64::INFINITY, 0.0));
    for constraint in constraints {
        let (middle, width) = (constraint.slope * x, constraint.width * pace);
        if middle - width > low.0 {
            low = (middle - width, constraint.slope);
        }
        if middle + width < high.0 {
            high = (middle + width, constraint.slope);
        }
    }
    (low, high)
}

/// Returns the highest `x`, at most `most`, from which an allowed `u` leads to at most `next`.
///
/// The violation is a convex, piecewise linear function of `x`, not positive at 0: Newton's method from the right
/// reaches its root in a few steps, piece by piece, without overshoot.
fn controllable(constraints: &[Constraint], pace: f64, step: f64, most: f64, next: f64) -> f64 {
    let mut x = most;
    for _ in 0..50 {
        let (low, mut high) = accelerations(constraints, pace, x);
        let braked = (next - x) / (2.0 * step);
        if braked < high.0 {
            high = (braked, -0.5 / step);
        }
        let (missing, slope) = (low.0 - high.0, low.1 - high.1);
        if missing <= 1e-12 * low.0.abs().max(1.0) {
            return x;
        }
        if slope <= 0.0 {
            return 0.0;
        }
        x = (x - missing / slope).max(0.0);
    }
    0.0
}
