//! The fastest way along a curve within velocity and acceleration limits: time-optimal path parameterization by
//! reachability analysis (Pham and Pham, "A new approach to time-optimal path parameterization based on reachability
//! analysis", 2018), on a grid along the curve.
//!
//! At each grid point `x = ṡ²` and `u = s̈` must keep `|q'·u + q''·x| ≤ a` for every joint, here and, because `u` holds
//! up to the next point, there as well. Backwards: the fastest `x` from which rest can be reached. Forwards: the
//! hardest `u` that stays below it.

use super::blend::Curve;

/// Limits of one joint along the way.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JointBound {
    /// Highest speed [rad/s].
    pub velocity: f64,
    /// Highest acceleration [rad/s²].
    pub acceleration: f64,
    /// Highest jerk [rad/s³]; infinite where none is given.
    pub jerk: f64,
}

/// A point of the grid: where on the curve, and how fast.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GridPoint {
    /// Index of the piece.
    pub piece: usize,
    /// Parameter from the piece's start [rad].
    pub at: f64,
    /// Parameter from the curve's start [rad].
    pub s: f64,
    /// Square of the parameter's speed [rad²/s²].
    pub x: f64,
    /// Time from the curve's start [s].
    pub time: f64,
}

/// Grid intervals of a corner. A line is one interval: on it `u` has the same bounds everywhere, so the fastest way
/// is to speed up, go on, and brake.
const BEND: usize = 8;

/// The grid of a curve with speeds and times, from rest to rest.
pub fn parameterize(curve: &Curve, bounds: &[JointBound]) -> Vec<GridPoint> {
    let (mut grid, rows) = grid(curve, bounds);
    let n = grid.len();
    if n < 2 {
        return grid;
    }
    let dof = bounds.len();
    let row = |i: usize| &rows[i * dof..(i + 1) * dof];
    let push = |i: usize| hardest(row(i), bounds);
    let is_line = |grid: &[GridPoint], i: usize| !curve[grid[i + 1].piece].bends;
    // Backwards: the fastest x from which the end can be reached.
    grid[n - 1].x = 0.0;
    for i in (0..n - 1).rev() {
        let (step, next, most) = (grid[i + 1].s - grid[i].s, grid[i + 1].x, grid[i].x);
        grid[i].x = match is_line(&grid, i) {
            true => most.min(next + 2.0 * step * push(i + 1)),
            false => controllable(row(i), row(i + 1), bounds, step, most, next),
        };
    }
    // Forwards: as fast as can be.
    let mut x: f64 = 0.0;
    for i in 0..n - 1 {
        let step = grid[i + 1].s - grid[i].s;
        grid[i].x = x;
        let high = match is_line(&grid, i) {
            true => push(i + 1),
            false => accelerations(row(i), row(i + 1), bounds, step, x).1.0,
        };
        x = (x + 2.0 * step * high).clamp(0.0, grid[i + 1].x);
    }
    grid[n - 1].x = 0.0;
    let mut full = Vec::with_capacity(2 * n);
    for i in 0..n {
        if i > 0 && is_line(&grid, i - 1) {
            switches(&grid[i - 1], &grid[i], push(i), fastest(row(i), bounds), &mut full);
        }
        full.push(grid[i]);
    }
    let mut time = 0.0;
    for i in 1..full.len() {
        let speed = 0.5 * (full[i - 1].x.sqrt() + full[i].x.sqrt());
        time += (full[i].s - full[i - 1].s) / speed.max(1e-9);
        full[i].time = time;
    }
    full
}

/// The points of a line where speeding up ends and braking begins.
fn switches(from: &GridPoint, to: &GridPoint, push: f64, fastest: f64, out: &mut Vec<GridPoint>) {
    let length = to.s - from.s;
    let peak = fastest.min(0.5 * (from.x + to.x) + push * length);
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

/// The hardest `u` on a line.
fn hardest(row: &[Row], bounds: &[JointBound]) -> f64 {
    let u = row.iter().zip(bounds).map(|(r, b)| b.acceleration / r.0.abs().max(1e-12));
    u.fold(f64::INFINITY, f64::min)
}

/// The highest `x` on a line.
fn fastest(row: &[Row], bounds: &[JointBound]) -> f64 {
    let x = row.iter().zip(bounds).map(|(r, b)| (b.velocity / r.0.abs().max(1e-12)).powi(2));
    x.fold(f64::INFINITY, f64::min)
}

/// First and second derivative of a joint at a grid point.
type Row = (f64, f64);

/// Grid points with the highest `x` that speeds allow, and the derivatives at each.
fn grid(curve: &Curve, bounds: &[JointBound]) -> (Vec<GridPoint>, Vec<Row>) {
    let mut grid: Vec<GridPoint> = Vec::new();
    let mut rows = Vec::new();
    let mut start = 0.0;
    for (p, piece) in curve.iter().enumerate() {
        let intervals = if piece.bends { BEND } else { 1 };
        for k in usize::from(p > 0)..=intervals {
            let at = piece.length * k as f64 / intervals as f64;
            let mut x = f64::INFINITY;
            for (j, bound) in bounds.iter().enumerate() {
                let jet = piece.at(j, at);
                rows.push((jet.d1, jet.d2));
                x = x.min((bound.velocity / jet.d1.abs().max(1e-12)).powi(2));
                // Where a joint turns round, no `u` can make up for curvature.
                if jet.d1.abs() < 1e-6 {
                    x = x.min(bound.acceleration / jet.d2.abs().max(1e-12));
                }
                if bound.jerk.is_finite() {
                    // The rate at which curvature changes takes jerk.
                    x = x.min((0.5 * bound.jerk / jet.d3.abs().max(1e-12)).powf(2.0 / 3.0));
                }
            }
            grid.push(GridPoint { piece: p, at, s: start + at, x, time: 0.0 });
        }
        start += piece.length;
    }
    (grid, rows)
}

/// A bound of `u` at some `x`, and how fast it changes with `x`.
type Edge = (f64, f64);

/// The lowest and highest `u` at `x` that keep all accelerations, here and one step on; lowest above highest where
/// there is none.
fn accelerations(here: &[Row], there: &[Row], bounds: &[JointBound], step: f64, x: f64) -> (Edge, Edge) {
    let (mut low, mut high) = ((f64::NEG_INFINITY, 0.0), (f64::INFINITY, 0.0));
    for ((h, t), bound) in here.iter().zip(there).zip(bounds) {
        // q'·u + q''·x here; q'·u + q''·(x + 2·step·u) there.
        for (a, b) in [(h.0, h.1), (t.0 + 2.0 * step * t.1, t.1)] {
            if a.abs() < 1e-9 {
                continue;
            }
            let inverse = 1.0 / a;
            let (slope, width) = (-b * inverse, bound.acceleration * inverse.abs());
            let middle = slope * x;
            if middle - width > low.0 {
                low = (middle - width, slope);
            }
            if middle + width < high.0 {
                high = (middle + width, slope);
            }
        }
    }
    (low, high)
}

/// The highest `x`, at most `most`, from which some allowed `u` leads to at most `next`.
///
/// What is missing for that is a convex function of `x`, made of straight pieces, and not positive at 0: Newton's way
/// from the right comes to its root in a few steps, piece by piece, and never passes it.
fn controllable(here: &[Row], there: &[Row], bounds: &[JointBound], step: f64, most: f64, next: f64) -> f64 {
    let mut x = most;
    for _ in 0..50 {
        let (low, mut high) = accelerations(here, there, bounds, step, x);
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
