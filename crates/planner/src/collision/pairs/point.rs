//! A point and a simple core.

use glamx::{DAffine3, DVec3};

/// Returns a point in a frame's coordinates.
pub fn local(p: DVec3, frame: &DAffine3) -> DVec3 {
    let d = p - frame.translation;
    let m = &frame.matrix3;
    DVec3::new(m.x_axis.dot(d), m.y_axis.dot(d), m.z_axis.dot(d))
}

/// Returns the distance of a point from a segment [m].
pub fn segment(p: DVec3, a: DVec3, b: DVec3) -> f64 {
    let d = b - a;
    let squared = d.length_squared();
    let t = if squared > 0.0 { ((p - a).dot(d) / squared).clamp(0.0, 1.0) } else { 0.0 };
    p.distance(a + d * t)
}

/// Returns the distance of a point from a box with half extents `half` [m]; 0 inside.
pub fn cuboid(p: DVec3, frame: &DAffine3, half: DVec3) -> f64 {
    (local(p, frame).abs() - half).max(DVec3::ZERO).length()
}

/// Returns the distance of a point from a cylinder along z [m]; 0 inside.
pub fn cylinder(p: DVec3, frame: &DAffine3, half: f64, radius: f64) -> f64 {
    let p = local(p, frame);
    let beside = (p.x.hypot(p.y) - radius).max(0.0);
    let above = (p.z.abs() - half).max(0.0);
    beside.hypot(above)
}
