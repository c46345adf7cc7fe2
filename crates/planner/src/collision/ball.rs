//! Bounding balls of solids.

use glamx::DVec3;

use super::shape::{Core, Solid};

/// Returns a small bounding ball of solids (Ritter's method: from two far points, grown as needed).
pub(super) fn around(solids: &[Solid]) -> (DVec3, f64) {
    let mut balls: Vec<(DVec3, f64)> = Vec::new();
    for solid in solids {
        let at = |p: DVec3| (solid.frame.transform_point3(p), solid.radius);
        let corners = |half: DVec3| {
            [-1.0, 1.0].map(|x| [-1.0, 1.0].map(|y| [-1.0, 1.0].map(|z| half * DVec3::new(x, y, z)))).concat().concat()
        };
        match &solid.core {
            Core::Hull(hull) => balls.extend(hull.polyhedron().points().iter().map(|p| at(*p))),
            Core::Mesh(mesh) => balls.extend(mesh.surface().vertices().iter().map(|p| at(*p))),
            Core::Cloud(cloud) => balls.extend(cloud.points().iter().map(|p| at(*p))),
            Core::Box { half } => balls.extend(corners(*half).into_iter().map(at)),
            Core::Cylinder { half, radius } => {
                balls.extend([-*half, *half].map(|z| (at(DVec3::Z * z).0, solid.radius + radius)))
            }
            Core::Segment { half } => balls.extend([-*half, *half].map(|z| at(DVec3::Z * z))),
            Core::Point => balls.push(at(DVec3::ZERO)),
        }
    }
    let farthest = |from: DVec3| {
        let by =
            |a: &&(DVec3, f64), b: &&(DVec3, f64)| (a.0.distance(from) + a.1).total_cmp(&(b.0.distance(from) + b.1));
        balls.iter().max_by(by).copied().unwrap_or((DVec3::ZERO, 0.0))
    };
    let a = farthest(balls.first().map_or(DVec3::ZERO, |b| b.0));
    let b = farthest(a.0);
    let direction = (b.0 - a.0).normalize_or_zero();
    let (mut center, mut radius) = ((a.0 - direction * a.1 + b.0 + direction * b.1) * 0.5, 0.0);
    // Moves towards the farthest solid in shrinking steps: close to the smallest ball, always containing all.
    for k in 1..=64 {
        let far = farthest(center);
        center += (far.0 - center) * (1.0 / f64::from(k + 1)).min(0.3);
    }
    let far = farthest(center);
    radius = f64::max(radius, far.0.distance(center) + far.1);
    (center, radius)
}
