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
    /// How deep points are inside.
    Depth(&'a dyn Depth),
    /// Nothing: the surface is open.
    Nothing,
}

/// How deep points are inside of a solid.
pub trait Depth {
    /// Returns about how deep a point is inside [m], 0 outside, and the direction in which that decreases, a unit
    /// vector or zero. Balls are chosen by it.
    fn depth(&self, p: [f64; 3]) -> (f64, [f64; 3]);

    /// Returns the radius of a ball about a point that is proven to be inside [m]; negative if none is.
    fn proven(&self, p: [f64; 3]) -> f64;

    /// Returns whether a point may be inside.
    fn may_be_inside(&self, p: [f64; 3]) -> bool;
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
    /// Radius of the ball about the same centre that is inside the solid [m]; negative if none is known.
    inner: f64,
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
            Inside::Depth(solid) => solid.may_be_inside(*p),
            Inside::Nothing => false,
        };
        let points: Vec<Vector> = polygons.iter().flatten().copied().chain(corners.filter(is_inside)).collect();
        if points.is_empty() {
            return None;
        }
        let (low, high) = bounds(points.iter().copied());
        let (ball, overshoot) = match inside {
            Inside::Depth(solid) => around(&points, FIELD_STEPS, |at| solid.depth(at)),
            _ => around(&points, STEPS, |at| shallowest(at, planes)),
        };
        let inner = match inside {
            Inside::Depth(solid) => solid.proven(ball.center),
            _ if planes.is_empty() => super::NONE,
            _ => ball.radius - overshoot,
        };
        Some(Self { polygons, low, high, ball, overshoot, inner })
    }

    /// Returns the ball as a node of a tree, and the ball about its centre that is inside the solid, if one is known.
    pub fn node(&self) -> super::Node {
        super::node(&self.ball, self.inner)
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
