//! The fastest way along a curve within velocity and acceleration limits: time-optimal path parameterization by
//! reachability analysis (Pham and Pham, "A new approach to time-optimal path parameterization based on reachability
//! analysis", 2018), on a grid along the curve.
//!
//! At each grid point `x = ṡ²` and `u = s̈` must keep `|q'·u + q''·x| ≤ a` for every joint, here and, because `u` holds
//! up to the next point, there as well. Backwards: the fastest `x` from which rest can be reached. Forwards: the
//! hardest `u` that stays below it.

use super::blend::{Curve, Piece};

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

/// What a piece may use of the limits, 0–1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Pace {
    /// Part of the highest `x`.
    pub x: f64,
    /// Part of the accelerations.
    pub acceleration: f64,
}

impl Pace {
    /// All of them.
    pub const FULL: Self = Self { x: 1.0, acceleration: 1.0 };
}

/// Grid intervals of a corner. A line is one interval: on it `u` has the same bounds everywhere, so the fastest way
/// is to speed up, go on, and brake.
const BEND: usize = 8;

/// The grid of a curve with speeds and times, from rest to rest.
pub fn parameterize(curve: &Curve, bounds: &[JointBound]) -> Vec<GridPoint> {
    let (walls, course) = course(curve, bounds);
    let paces = vec![Pace::FULL; curve.len()];
    let speeds = course.fastest(&walls, &paces);
    course.timed(&speeds, &paces)
}

/// Keeps `u` within `width` of `slope·x`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Wall {
    slope: f64,
    width: f64,
}

/// An interval of the grid.
#[derive(Debug, Clone, Copy)]
enum Way {
    /// A line, with the highest `u` and the highest `x` on it.
    Line { push: f64, most: f64 },
    /// A part of a corner, with its first wall and the one after its last.
    Bend { first: usize, end: usize },
}

/// The grid along a curve.
#[derive(Debug, Clone, Default)]
pub(super) struct Course {
    /// Its points, with the highest `x` at each.
    points: Vec<GridPoint>,
    /// The way from each point to the next.
    ways: Vec<Way>,
}

/// The grid along a curve, and the bounds of `u` on its corners.
pub(super) fn course(curve: &Curve, bounds: &[JointBound]) -> (Vec<Wall>, Course) {
    let corners = curve.iter().filter(|piece| piece.bends).count();
    let intervals = corners * BEND + curve.len() - corners;
    let mut walls = Vec::with_capacity(corners * BEND * bounds.len() * 2);
    let mut course = Course { points: Vec::with_capacity(intervals + 1), ways: Vec::with_capacity(intervals) };
    let mut start = 0.0;
    for (p, piece) in curve.iter().enumerate() {
        let entry = highest(piece, 0.0, bounds);
        match course.points.last_mut() {
            Some(point) => point.x = point.x.min(entry),
            None => course.points.push(GridPoint { x: entry, ..GridPoint::default() }),
        }
        if piece.bends {
            course.bend(p, piece, start, bounds, &mut walls);
        } else {
            let (at, most) = (piece.length, fastest(piece, bounds));
            course.ways.push(Way::Line { push: hardest(piece, bounds), most });
            course.points.push(GridPoint { piece: p, at, s: start + at, x: most, time: 0.0 });
        }
        start += piece.length;
    }
    (walls, course)
}

impl Course {
    fn bend(&mut self, p: usize, piece: &Piece, start: f64, bounds: &[JointBound], walls: &mut Vec<Wall>) {
        let step = piece.length / BEND as f64;
        let mut here = piece.turned(0.0);
        for k in 1..=BEND {
            let at = step * k as f64;
            let there = piece.turned(at);
            let first = walls.len();
            for ((direction, turn), bound) in piece.direction.iter().zip(&piece.turn).zip(bounds) {
                // q'·u + q''·x here; q'·u + q''·(x + 2·step·u) there.
                let ahead = turn * there.d1;
                for (a, b) in [
                    (direction + turn * here.part, turn * here.d1),
                    (direction + turn * there.part + 2.0 * step * ahead, ahead),
                ] {
                    if a.abs() >= 1e-9 {
                        let inverse = 1.0 / a;
                        walls.push(Wall { slope: -b * inverse, width: bound.acceleration * inverse.abs() });
                    }
                }
            }
            self.ways.push(Way::Bend { first, end: walls.len() });
            let x = highest(piece, at, bounds);
            self.points.push(GridPoint { piece: p, at, s: start + at, x, time: 0.0 });
            here = there;
        }
    }

    /// The highest `x` at each point with each piece at its pace, from rest to rest.
    pub fn fastest(&self, walls: &[Wall], paces: &[Pace]) -> Vec<f64> {
        let (points, n) = (&self.points, self.points.len());
        let mut speeds = vec![0.0; n];
        // Backwards: from where the next point can be reached.
        for i in (1..n - 1).rev() {
            let (step, next) = (points[i + 1].s - points[i].s, speeds[i + 1]);
            let pace = paces[points[i + 1].piece];
            // The first point of a piece is the last one of the piece before.
            let most = points[i].x * pace.x.min(paces[points[i].piece].x);
            speeds[i] = match self.ways[i] {
                Way::Line { push, .. } => most.min(next + 2.0 * step * push * pace.acceleration),
                Way::Bend { first, end } => controllable(&walls[first..end], pace.acceleration, step, most, next),
            };
        }
        // Forwards: as fast as can be, up to that.
        let mut x: f64 = 0.0;
        for (i, way) in self.ways.iter().enumerate() {
            let step = points[i + 1].s - points[i].s;
            let pace = paces[points[i + 1].piece].acceleration;
            let high = match *way {
                Way::Line { push, .. } => push * pace,
                Way::Bend { first, end } => accelerations(&walls[first..end], pace, x).1.0,
            };
            x = (x + 2.0 * step * high).clamp(0.0, speeds[i + 1]);
            speeds[i + 1] = x;
        }
        speeds
    }

    /// The points with these speeds and their times, and on lines those where speeding up ends and braking begins.
    pub fn timed(&self, speeds: &[f64], paces: &[Pace]) -> Vec<GridPoint> {
        let mut full: Vec<GridPoint> = Vec::with_capacity(3 * self.points.len());
        for (i, (point, &x)) in self.points.iter().zip(speeds).enumerate() {
            let to = GridPoint { x, ..*point };
            if let (Some(&from), Some(Way::Line { push, most })) = (full.last(), self.ways.get(i.wrapping_sub(1))) {
                let pace = paces[to.piece];
                switches(&from, &to, push * pace.acceleration, most * pace.x, 0.0, &mut full);
            }
            full.push(to);
        }
        set_times(&mut full);
        full
    }
}

/// Fills in the times of points from their speeds.
pub(super) fn set_times(points: &mut [GridPoint]) {
    let mut last = GridPoint::default();
    for point in points {
        point.time = last.time;
        if point.s > last.s {
            point.time += (point.s - last.s) / (0.5 * (last.x.sqrt() + point.x.sqrt())).max(1e-9);
        }
        last = *point;
    }
}

/// The points of a line where speeding up ends and braking begins; in between it goes on for `cruise` [s], or does not
/// get faster than at its faster end.
pub(super) fn switches(
    from: &GridPoint,
    to: &GridPoint,
    push: f64,
    fastest: f64,
    cruise: f64,
    out: &mut Vec<GridPoint>,
) {
    let length = to.s - from.s;
    let free = 0.5 * (from.x + to.x) + push * length;
    // p² + push·cruise·p = free, for the speed p that leaves that time.
    let lost = 0.5 * push * cruise;
    let peak = ((lost * lost + free).sqrt() - lost).powi(2).max(from.x).max(to.x).min(fastest);
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
pub(super) fn hardest(line: &Piece, bounds: &[JointBound]) -> f64 {
    let u = line.direction.iter().zip(bounds).map(|(d1, b)| b.acceleration / d1.abs().max(1e-12));
    u.fold(f64::INFINITY, f64::min)
}

/// The highest `x` on a line.
pub(super) fn fastest(line: &Piece, bounds: &[JointBound]) -> f64 {
    let speed = line.direction.iter().zip(bounds).map(|(d1, b)| b.velocity / d1.abs().max(1e-12));
    speed.fold(f64::INFINITY, f64::min).powi(2)
}

/// The highest `x` at a point of a piece, by the speeds of the joints and by what no `u` can make up for.
fn highest(piece: &Piece, at: f64, bounds: &[JointBound]) -> f64 {
    let t = piece.turned(at);
    let (mut speed, mut x, mut cube) = (f64::INFINITY, f64::INFINITY, f64::INFINITY);
    for ((direction, turn), bound) in piece.direction.iter().zip(&piece.turn).zip(bounds) {
        let d1 = (direction + turn * t.part).abs();
        speed = speed.min(bound.velocity / d1.max(1e-12));
        // Where a joint turns round, curvature takes all its acceleration.
        if d1 < 1e-6 {
            x = x.min(bound.acceleration / (turn * t.d1).abs().max(1e-12));
        }
        // The rate at which curvature changes takes jerk.
        cube = cube.min(0.5 * bound.jerk / (turn * t.d2).abs().max(1e-12));
    }
    if cube.is_finite() {
        speed = speed.min(cube.cbrt());
    }
    x.min(speed * speed)
}

/// A bound of `u` at some `x`, and how fast it changes with `x`.
type Edge = (f64, f64);

/// The lowest and highest `u` at `x` that keep all accelerations, here and one step on; lowest above highest where
/// there is none.
fn accelerations(walls: &[Wall], pace: f64, x: f64) -> (Edge, Edge) {
    let (mut low, mut high) = ((f64::NEG_INFINITY, 0.0), (f64::INFINITY, 0.0));
    for wall in walls {
        let (middle, width) = (wall.slope * x, wall.width * pace);
        if middle - width > low.0 {
            low = (middle - width, wall.slope);
        }
        if middle + width < high.0 {
            high = (middle + width, wall.slope);
        }
    }
    (low, high)
}

/// The highest `x`, at most `most`, from which some allowed `u` leads to at most `next`.
///
/// What is missing for that is a convex function of `x`, made of straight pieces, and not positive at 0: Newton's way
/// from the right comes to its root in a few steps, piece by piece, and never passes it.
fn controllable(walls: &[Wall], pace: f64, step: f64, most: f64, next: f64) -> f64 {
    let mut x = most;
    for _ in 0..50 {
        let (low, mut high) = accelerations(walls, pace, x);
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
