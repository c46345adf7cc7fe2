//! Any two cores, with parry: GJK for convex ones, a tree of triangles for meshes, a tree of points for clouds. Also
//! closest points and penetration depths, for reports rather than during planning.

use glamx::{DAffine3, DPose3, DQuat, DVec3};
use parry3d_f64::query::gjk::{self, CsoPoint, GJKResult, VoronoiSimplex};
use parry3d_f64::query::{self, ClosestPoints};
use parry3d_f64::shape::{Ball, ConvexPolyhedron, Cuboid, Cylinder, Segment, Shape, SupportMap, Triangle};

use super::super::shape::{Mesh, Placed};
use super::super::triangle_pair::distance_squared;
use super::super::triangles::gap_to_box;
use super::segment_box;

/// Closest points of two cores.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Nearest {
    /// Distance of the cores [m]; negative: penetration depth.
    pub distance: f64,
    /// Point on or in the first core, in the common frame [m].
    pub a: DVec3,
    /// Point on or in the second core.
    pub b: DVec3,
}

/// Returns the distance of two cores [m], 0 if they overlap.
pub fn distance(a: &Placed, b: &Placed) -> f64 {
    if let Some((cloud, other)) = cloud_and_other(a, b) {
        let (ball, radius) = other.ball();
        return cloud.0.nearest(cloud.1, ball, radius, |p| super::distance(&Placed::Point(p), other)).0;
    }
    if holds(a, b) || holds(b, a) {
        return 0.0;
    }
    with_shape(a, |pa, sa| {
        with_shape(b, |pb, sb| match (support(a, sa), support(b, sb)) {
            (Some(ma), Some(mb)) => convex_closest(&pa.inv_mul(pb), ma, mb).map_or(0.0, |found| found.distance()),
            _ => query::distance(pa, sa, pb, sb).map_or(0.0, |d| d.distance),
        })
    })
}

/// Returns whether two cores are within `reach` [m] of each other.
pub fn within(a: &Placed, b: &Placed, reach: f64) -> bool {
    if let Some((cloud, other)) = cloud_and_other(a, b) {
        let (ball, radius) = other.ball();
        return cloud.0.any_within(cloud.1, ball, radius, reach, |p| super::within(&Placed::Point(p), other, reach));
    }
    if let (Placed::Mesh(frame, mesh), other) | (other, Placed::Mesh(frame, mesh)) = (a, b) {
        // Where surfaces cross, rounding separates no triangles.
        return surface_distance(frame, mesh, other, reach, reach + 2.0 * CROSSING) <= reach + CROSSING
            || holds(a, b)
            || holds(b, a);
    }
    with_shape(a, |pa, sa| {
        with_shape(b, |pb, sb| match (support(a, sa), support(b, sb)) {
            (Some(ma), Some(mb)) => convex_within(&pa.inv_mul(pb), ma, mb, reach),
            // A pair that parry does not support counts as touching.
            _ => true,
        })
    })
}

/// Starts of GJK besides the direction between the shapes.
const STARTS: [DVec3; 4] = [DVec3::X, DVec3::Y, DVec3::Z, DVec3::new(0.36, -0.48, 0.8)];
/// An answer of GJK is the distance if a direction separates the shapes by as much, less this [m].
const PROVEN: f64 = 1e-6;
/// The same for the best of several answers: at curved surfaces none is better.
const BELIEVED: f64 = 1e-5;

/// Distance of crossing surfaces that rounding makes of zero [m].
const CROSSING: f64 = 1e-9;

/// Returns how far two convex shapes are apart along a direction: a lower bound of their distance [m].
fn separation(pose: &DPose3, a: &dyn SupportMap, b: &dyn SupportMap, direction: DVec3) -> f64 {
    let n = direction.normalize_or_zero();
    n.dot(b.support_point(pose, -n) - a.local_support_point(n))
}

/// Distance of two convex shapes, and where.
#[derive(Debug, Clone, Copy)]
struct Closest {
    /// A direction that separates the shapes by as much has been found [m].
    lower: f64,
    /// Distance of the two points [m].
    upper: f64,
    a: DVec3,
    b: DVec3,
}

impl Closest {
    /// Returns the distance [m]; the lower bound if the points are not proven to be the closest.
    fn distance(&self) -> f64 {
        if self.lower >= self.upper - BELIEVED { self.upper } else { self.lower }
    }

    /// Improves this with the answer of GJK from a start; returns false if the shapes overlap.
    fn improve(&mut self, pose: &DPose3, a: &dyn SupportMap, b: &dyn SupportMap, start: DVec3) -> bool {
        let mut simplex = VoronoiSimplex::new();
        simplex.reset(CsoPoint::from_shapes(pose, a, b, start));
        match gjk::closest_points(pose, a, b, f64::MAX, true, &mut simplex) {
            GJKResult::Intersection => return false,
            GJKResult::ClosestPoints(p, q, _) => {
                self.lower = self.lower.max(separation(pose, a, b, q - p));
                if p.distance(q) < self.upper {
                    (self.upper, self.a, self.b) = (p.distance(q), p, q);
                }
            }
            GJKResult::Proximity(_) | GJKResult::NoIntersection(_) => {}
        }
        true
    }
}

/// Returns the closest points of two convex shapes, in the frame of `a`; `None` if the shapes overlap. parry's GJK ends
/// with points that are not the closest when it makes no progress, mostly at parallel faces; then it starts again from
/// elsewhere, also with the shapes exchanged.
fn convex_closest(pose: &DPose3, a: &dyn SupportMap, b: &dyn SupportMap) -> Option<Closest> {
    let mut best = Closest { lower: 0.0, upper: f64::INFINITY, a: DVec3::ZERO, b: pose.translation };
    if !best.improve(pose, a, b, (-pose.translation).try_normalize().unwrap_or(DVec3::X)) {
        return None;
    }
    if best.lower >= best.upper - PROVEN {
        return Some(best);
    }
    let back = pose.inverse();
    let mut other = Closest { upper: f64::INFINITY, ..best };
    for start in std::iter::once((-back.translation).try_normalize().unwrap_or(DVec3::X)).chain(STARTS) {
        if !best.improve(pose, a, b, start) || !other.improve(&back, b, a, start) {
            return None;
        }
    }
    let lower = best.lower.max(other.lower);
    let exchanged = Closest { lower, a: pose * other.b, b: pose * other.a, upper: other.upper };
    Some(if other.upper < best.upper { exchanged } else { Closest { lower, ..best } })
}

/// Returns whether two convex shapes are within `reach` [m]: GJK ends as soon as the distance is known to be below or
/// above. Both have to be proven, by points or by a direction.
fn convex_within(pose: &DPose3, a: &dyn SupportMap, b: &dyn SupportMap, reach: f64) -> bool {
    let direction = pose.translation.try_normalize().unwrap_or(DVec3::X);
    let mut simplex = VoronoiSimplex::new();
    simplex.reset(CsoPoint::from_shapes(pose, a, b, direction));
    match gjk::closest_points(pose, a, b, reach.max(0.0), false, &mut simplex) {
        GJKResult::Intersection => true,
        GJKResult::NoIntersection(n) if separation(pose, a, b, n) > reach => false,
        GJKResult::Proximity(_) if simplex.project_origin_and_reduce().length() <= reach => true,
        // It may have ended without a result, or with an upper bound that is not the distance.
        _ => convex_closest(pose, a, b).is_none_or(|found| found.distance() <= reach),
    }
}

/// Returns the distance of the triangles of a mesh from another core, at most `cutoff` [m]; ends at any up to `enough`.
fn surface_distance(at: &DAffine3, mesh: &Mesh, other: &Placed, enough: f64, cutoff: f64) -> f64 {
    let (triangles, into) = (mesh.triangles(), at.inverse());
    match other {
        Placed::Mesh(frame, other) => triangles.distance_from(other.triangles(), &(into * *frame), enough, cutoff),
        Placed::Point(p) => {
            let p = into.transform_point3(*p);
            triangles.closest(p).distance(p).min(cutoff)
        }
        Placed::Segment(a, b) => {
            let [a, b] = [*a, *b].map(|p| into.transform_point3(p));
            let apart = |middle, half| segment_box::distance(a, b, &DAffine3::from_translation(middle), half);
            triangles.distance(apart, |triangle, _| distance_squared(triangle, &[a, b, b]).sqrt(), enough, cutoff)
        }
        _ => with_shape(other, |pose_of_other, shape| {
            let (Some(map), Some((guard, size))) = (support(other, shape), other.guard()) else { return 0.0 };
            let (guard, pose_of_other) = (into * guard, pose(at).inv_mul(pose_of_other));
            let apart = |middle, half| gap_to_box(middle, half, &guard, size);
            let distance = |[a, b, c]: &[DVec3; 3], best: f64| {
                let triangle = Triangle::new(*a, *b, *c);
                match convex_within(&pose_of_other, &triangle, map, best) {
                    true => convex_closest(&pose_of_other, &triangle, map).map_or(0.0, |found| found.distance()),
                    false => best,
                }
            };
            triangles.distance(apart, distance, enough, cutoff)
        }),
    }
}

/// Returns the distance of two cores, at most `cutoff` [m]; 0 if they overlap.
pub fn distance_up_to(a: &Placed, b: &Placed, cutoff: f64) -> f64 {
    match (a, b) {
        (Placed::Mesh(frame, mesh), other) | (other, Placed::Mesh(frame, mesh)) => {
            let distance = surface_distance(frame, mesh, other, 0.0, cutoff);
            if distance <= CROSSING || holds(a, b) || holds(b, a) { 0.0 } else { distance }
        }
        _ => super::distance(a, b).min(cutoff),
    }
}

/// Returns the closest points of two cores, or their penetration depth.
pub fn nearest(a: &Placed, b: &Placed) -> Nearest {
    if let Some((cloud, other)) = cloud_and_other(a, b) {
        let (ball, radius) = other.ball();
        let (_, p) = cloud.0.nearest(cloud.1, ball, radius, |p| super::distance(&Placed::Point(p), other));
        let found = nearest(&Placed::Point(p), other);
        let swapped = !matches!(a, Placed::Cloud(..));
        return if swapped { Nearest { a: found.b, b: found.a, ..found } } else { found };
    }
    let apart = with_shape(a, |pa, sa| {
        with_shape(b, |pb, sb| {
            let found = convex_closest(&pa.inv_mul(pb), support(a, sa)?, support(b, sb)?)?;
            Some(Nearest { distance: found.distance(), a: pa * found.a, b: pa * found.b })
        })
    });
    apart.unwrap_or_else(|| nearest_of_any(a, b))
}

/// The same for cores that overlap, and for meshes.
fn nearest_of_any(a: &Placed, b: &Placed) -> Nearest {
    let inside = holds(a, b) || holds(b, a);
    if let (Placed::Mesh(f, one), Placed::Mesh(g, two)) = (a, b)
        && let Some([p, q]) = one.triangles().nearest(two.triangles(), &(f.inverse() * *g))
    {
        let sign = if inside { -1.0 } else { 1.0 };
        return Nearest { distance: sign * p.distance(q), a: f.transform_point3(p), b: f.transform_point3(q) };
    }
    with_hull(a, |pa, sa| {
        with_hull(b, |pb, sb| {
            let touching = |at: DVec3| Nearest { distance: 0.0, a: at, b: at };
            match query::closest_points(pa, sa, pb, sb, f64::MAX) {
                Ok(ClosestPoints::WithinMargin(p, q)) => {
                    let sign = if inside { -1.0 } else { 1.0 };
                    Nearest { distance: sign * p.distance(q), a: p, b: q }
                }
                Ok(ClosestPoints::Intersecting) => match query::contact(pa, sa, pb, sb, 0.0) {
                    Ok(Some(c)) => Nearest { distance: c.dist.min(0.0), a: c.point1, b: c.point2 },
                    _ => touching(a.ball().0),
                },
                _ => touching(a.ball().0),
            }
        })
    })
}

type CloudRef<'a> = (&'a super::super::cloud::Cloud, &'a DAffine3);

fn cloud_and_other<'a>(a: &'a Placed<'a>, b: &'a Placed<'a>) -> Option<(CloudRef<'a>, &'a Placed<'a>)> {
    match (a, b) {
        (Placed::Cloud(f, c), other) | (other, Placed::Cloud(f, c)) => Some(((*c, f), other)),
        _ => None,
    }
}

/// Returns whether a closed mesh contains the other core, which its surface alone would not touch: then it contains any
/// point of it. The centre of another mesh may be none: that of a fork is between its fingers.
fn holds(mesh: &Placed, other: &Placed) -> bool {
    let Placed::Mesh(frame, mesh) = mesh else { return false };
    let point = match other {
        Placed::Mesh(frame, other) => other.surface().vertices().first().map(|vertex| frame.transform_point3(*vertex)),
        Placed::Hull(frame, other) => other.polyhedron().points().first().map(|vertex| frame.transform_point3(*vertex)),
        _ => Some(other.ball().0),
    };
    mesh.is_closed() && point.is_some_and(|point| mesh.holds(super::point::local(point, frame)))
}

fn pose(frame: &DAffine3) -> DPose3 {
    DPose3 { rotation: DQuat::from_mat3(&frame.matrix3), translation: frame.translation }
}

fn with_shape<R>(placed: &Placed, f: impl FnOnce(&DPose3, &dyn Shape) -> R) -> R {
    match placed {
        Placed::Point(p) => f(&DPose3 { rotation: DQuat::IDENTITY, translation: *p }, &Ball::new(0.0)),
        Placed::Segment(a, b) => f(&DPose3::IDENTITY, &Segment::new(*a, *b)),
        Placed::Box(frame, half) => f(&pose(frame), &Cuboid::new(*half)),
        Placed::Cylinder(frame, half, radius) => {
            // parry's cylinders have the axis y.
            let mut upright = pose(frame);
            upright.rotation *= DQuat::from_rotation_x(std::f64::consts::FRAC_PI_2);
            f(&upright, &Cylinder::new(*half, *radius))
        }
        Placed::Hull(frame, hull) => f(&pose(frame), hull.polyhedron()),
        Placed::Mesh(frame, mesh) => f(&pose(frame), mesh.surface()),
        Placed::Cloud(frame, _) => f(&pose(frame), &Ball::new(0.0)),
    }
}

/// Returns what GJK needs of a convex core; `shape` is parry's.
fn support<'a>(placed: &Placed<'a>, shape: &'a dyn Shape) -> Option<&'a dyn SupportMap> {
    match placed {
        Placed::Hull(_, hull) => Some(*hull),
        _ => shape.as_support_map(),
    }
}

/// Calls `f` with boxes as convex hulls: parry's closest points of boxes are not always the closest.
fn with_hull<R>(placed: &Placed, f: impl FnOnce(&DPose3, &dyn Shape) -> R) -> R {
    if let Placed::Box(frame, half) = placed {
        let corner = |i: u8| {
            let sign = |bit: u8| if i >> bit & 1 == 0 { -1.0 } else { 1.0 };
            *half * DVec3::new(sign(0), sign(1), sign(2))
        };
        let corners: Vec<DVec3> = (0..8).map(corner).collect();
        if let Some(hull) = ConvexPolyhedron::from_convex_hull(&corners) {
            return f(&pose(frame), &hull);
        }
    }
    with_shape(placed, f)
}
