//! The surface of a core as triangles: exact for meshes and flat ones, slightly outside of round ones.

use glamx::DVec3;
use parry3d_f64::shape::ConvexPolyhedron;

use super::shape::Core;

/// Number of sides of the prism that replaces a cylinder: 0.5 % wider.
const SIDES: usize = 32;

/// Returns triangles whose solid contains a core, in its frame; `None` for a cloud. A point and a segment are triangles
/// without an area.
pub(super) fn outline(core: &Core) -> Option<Vec<[DVec3; 3]>> {
    let of = |polyhedron: &ConvexPolyhedron| {
        let (points, triangles) = polyhedron.to_trimesh();
        triangles.iter().map(|corners| corners.map(|i| points[i as usize])).collect()
    };
    match core {
        Core::Point => Some(vec![[DVec3::ZERO; 3]]),
        Core::Segment { half } => Some(vec![[-DVec3::Z * *half, DVec3::Z * *half, DVec3::Z * *half]]),
        Core::Box { half } => cuboid(*half).as_ref().map(of),
        Core::Cylinder { half, radius } => prism(*half, *radius).as_ref().map(of),
        Core::Hull(hull) => Some(match hull.surface() {
            Some(mesh) => mesh.triangles().all().to_vec(),
            None => of(hull.polyhedron()),
        }),
        Core::Mesh(mesh) => Some(mesh.triangles().all().to_vec()),
        Core::Cloud(_) => None,
    }
}

/// Returns a box about the origin with these half extents [m].
pub(super) fn cuboid(half: DVec3) -> Option<ConvexPolyhedron> {
    let corner = |k: usize| DVec3::new(sign(k), sign(k >> 1), sign(k >> 2)) * half;
    ConvexPolyhedron::from_convex_hull(&(0..8).map(corner).collect::<Vec<_>>())
}

/// Returns a prism about a cylinder along z with this half length and radius [m].
pub(super) fn prism(half: f64, radius: f64) -> Option<ConvexPolyhedron> {
    let outside = radius / (std::f64::consts::PI / SIDES as f64).cos();
    let side = |k: usize| {
        let (sin, cos) = (std::f64::consts::TAU * (k / 2) as f64 / SIDES as f64).sin_cos();
        DVec3::new(outside * cos, outside * sin, half * sign(k))
    };
    ConvexPolyhedron::from_convex_hull(&(0..2 * SIDES).map(side).collect::<Vec<_>>())
}

fn sign(bit: usize) -> f64 {
    if bit & 1 == 1 { 1.0 } else { -1.0 }
}
