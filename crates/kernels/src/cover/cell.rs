//! The part of a solid in a box: its surface as polygons, cut at the box, and the corners of the box that are inside.

use super::ball::{Ball, FIELD_STEPS, Plane, STEPS, around, shallowest};
use super::vector::{Vector, along, bounds};

/// Interior of a closed surface.
#[derive(Clone, Copy)]
pub enum Inside<'a> {
    /// The surface is convex.
    Convex,
    /// Whether a point is inside.
    Test(&'a dyn Fn([f64; 3]) -> bool),
    /// How deep a point is inside.
    Depth(&'a dyn Fn([f64; 3]) -> Depth),
    /// Nothing: the surface is open.
    Nothing,
}

/// A point and the surface of a solid.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Depth {
    /// Distance from the surface, if the point is known to be inside; otherwise negative: all around the point that is
    /// closer than this is inside [m].
    pub depth: f64,
    /// Direction in which the depth decreases; a unit vector.
    pub outwards: [f64; 3],
    /// Whether the point may be inside.
    pub may_be_inside: bool,
}

/// A part of a solid and the ball that contains it.
#[derive(Debug, Clone)]
pub(super) struct Cell {
    polygons: Vec<Vec<Vector>>,
    /// The box, no larger than its content.
    low: Vector,
    high: Vector,
    pub ball: Ball,
    /// How far the ball's surface is outside of the solid at most [m].
    pub overshoot: f64,
    /// Whether it is known how deep its ball's centre is inside.
    has_depth: bool,
}

impl Cell {
    /// Cuts out the part in a box; `None` if there is none.
    ///
    /// Whatever part of the solid lies inside the box, its extreme points are on its surface or corners of the box: a
    /// ball that contains the polygons and the corners that are inside contains the part.
    pub fn new(
        polygons: Vec<Vec<Vector>>,
        low: Vector,
        high: Vector,
        planes: &[Plane],
        inside: Inside<'_>,
    ) -> Option<Self> {
        let corners = (0..8).map(|k| std::array::from_fn(|i| if k >> i & 1 == 1 { high[i] } else { low[i] }));
        let is_inside = |p: &Vector| match inside {
            Inside::Convex => planes.iter().all(|plane| plane.depth(*p) >= 0.0),
            Inside::Test(test) => test(*p),
            Inside::Depth(depth) => depth(*p).may_be_inside,
            Inside::Nothing => false,
        };
        let points: Vec<Vector> = polygons.iter().flatten().copied().chain(corners.filter(is_inside)).collect();
        if points.is_empty() {
            return None;
        }
        let (low, high) = bounds(points.iter().copied());
        let (ball, overshoot) = match inside {
            Inside::Depth(depth) => around(&points, FIELD_STEPS, |at| {
                let Depth { depth, outwards, .. } = depth(at);
                (depth, outwards)
            }),
            _ => around(&points, STEPS, |at| shallowest(at, planes)),
        };
        let has_depth = !planes.is_empty() || matches!(inside, Inside::Depth(_));
        Some(Self { polygons, low, high, ball, overshoot, has_depth })
    }

    /// Returns the ball as a node of a tree, and the ball about its centre that is inside the solid, if one is known.
    pub fn node(&self) -> super::Node {
        super::node(&self.ball, if self.has_depth { self.ball.radius - self.overshoot } else { super::NONE })
    }

    /// Halves the box across its longest side.
    pub fn halves(&self, planes: &[Plane], inside: Inside<'_>) -> [Option<Self>; 2] {
        let side = |i: &usize| self.high[*i] - self.low[*i];
        let axis = (0..3).max_by(|a, b| side(a).total_cmp(&side(b))).unwrap_or(0);
        let at = 0.5 * (self.low[axis] + self.high[axis]);
        let half = |sign: f64| {
            let (mut low, mut high) = (self.low, self.high);
            if sign > 0.0 {
                low[axis] = at
            } else {
                high[axis] = at
            }
            let cut = self.polygons.iter().map(|polygon| cut(polygon, axis, at, sign));
            Self::new(cut.filter(|polygon| !polygon.is_empty()).collect(), low, high, planes, inside)
        };
        [half(-1.0), half(1.0)]
    }
}

/// Cuts a convex polygon at a plane across an axis; keeps the side above if `sign` is positive (Sutherland and Hodgman
/// 1974).
fn cut(polygon: &[Vector], axis: usize, at: f64, sign: f64) -> Vec<Vector> {
    let above = |p: &Vector| sign * (p[axis] - at);
    let mut kept = Vec::with_capacity(polygon.len() + 1);
    for (i, p) in polygon.iter().enumerate() {
        let next = &polygon[(i + 1) % polygon.len()];
        let (a, b) = (above(p), above(next));
        if a >= 0.0 {
            kept.push(*p);
        }
        if (a > 0.0 && b < 0.0) || (a < 0.0 && b > 0.0) {
            kept.push(along(*p, a / (a - b), [next[0] - p[0], next[1] - p[1], next[2] - p[2]]));
        }
    }
    kept
}
