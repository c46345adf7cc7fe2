//! Balls around points.

use super::vector::{Vector, along, bounds, direction, distance, dot, sub};

/// Steps of the descent: the centre is within about 1 % of the best one.
pub(super) const STEPS: usize = 60;
/// Steps where the depth of a point in a solid takes long to compute.
pub(super) const FIELD_STEPS: usize = 20;

/// A ball.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Ball {
    pub center: Vector,
    pub radius: f64,
}

/// A half space that contains a solid: `normal · x ≤ offset`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Plane {
    pub normal: Vector,
    pub offset: f64,
}

impl Plane {
    /// Returns the distance of a point from the plane, positive inside.
    pub fn depth(&self, p: Vector) -> f64 {
        self.offset - dot(self.normal, p)
    }
}

/// Returns the ball around points whose surface is least far outside of a convex solid, and how far that is at most;
/// without planes, the smallest ball and its radius. The points may be any whose convex hull contains what is covered.
/// `depth`: how deep a point is inside, and the direction in which that decreases.
///
/// Minimizes `max |x − p| − depth(x)`, which is convex if the solid is, by subgradients.
pub(super) fn around(points: &[Vector], steps: usize, depth: impl Fn(Vector) -> (f64, Vector)) -> (Ball, f64) {
    let (low, high) = bounds(points.iter().copied());
    let mut at = std::array::from_fn(|i| 0.5 * (low[i] + high[i]));
    let mut size = 0.25 * distance(low, high);
    let mut best = (Ball { center: at, radius: f64::INFINITY }, f64::INFINITY);
    // The steps shrink to the same size.
    let shrink = 0.9_f64.powf(STEPS as f64 / steps as f64);
    for _ in 0..steps {
        let (radius, far) = farthest(at, points);
        let (depth, normal) = depth(at);
        if radius - depth < best.1 {
            best = (Ball { center: at, radius }, radius - depth);
        }
        let down = along(direction(sub(far, at)), -1.0, normal);
        if dot(down, down) < 1e-12 {
            break;
        }
        at = along(at, size, direction(down));
        size *= shrink;
    }
    best
}

fn farthest(from: Vector, points: &[Vector]) -> (f64, Vector) {
    let mut most = (0.0, from);
    for p in points {
        let d = sub(*p, from);
        let squared = dot(d, d);
        if squared > most.0 {
            most = (squared, *p);
        }
    }
    (most.0.sqrt(), most.1)
}

/// Returns the depth of a point in a convex solid and the normal of the nearest plane; zero without planes.
pub(super) fn shallowest(at: Vector, planes: &[Plane]) -> (f64, Vector) {
    let mut least = (f64::INFINITY, [0.0; 3]);
    for plane in planes {
        let depth = plane.depth(at);
        if depth < least.0 {
            least = (depth, plane.normal);
        }
    }
    if planes.is_empty() { (0.0, [0.0; 3]) } else { least }
}

/// Returns a ball around balls: close to the smallest.
pub(super) fn enclosing(balls: &[Ball]) -> Ball {
    let (low, high) =
        bounds(balls.iter().flat_map(|b| [b.center.map(|x| x - b.radius), b.center.map(|x| x + b.radius)]));
    let mut at: Vector = std::array::from_fn(|i| 0.5 * (low[i] + high[i]));
    let mut best = Ball { center: at, radius: f64::INFINITY };
    let mut size = 0.25 * distance(low, high);
    for _ in 0..STEPS {
        let reach = |b: &Ball| distance(b.center, at) + b.radius;
        let Some(far) = balls.iter().max_by(|a, b| reach(a).total_cmp(&reach(b))) else { break };
        let radius = reach(far);
        if radius < best.radius {
            best = Ball { center: at, radius };
        }
        at = along(at, size, direction(sub(far.center, at)));
        size *= 0.9;
    }
    best
}
