//! A segment and a box. Along the segment the squared distance from the box is convex and piecewise quadratic, with
//! breaks where the segment crosses the planes of the box's faces: its minimum is computed exactly, piece by piece.

use glamx::{DAffine3, DVec3};

use super::point::local;

/// Returns the distance of segment `a`–`b` from a box with half extents `half` [m]; 0 if they overlap.
pub fn distance(a: DVec3, b: DVec3, frame: &DAffine3, half: DVec3) -> f64 {
    let (a, b) = (local(a, frame), local(b, frame));
    let d = b - a;
    let at = |t: f64| ((a + d * t).abs() - half).max(DVec3::ZERO);
    // Half the derivative of the squared distance: it never decreases along the segment.
    let slope = |t: f64| {
        let p = a + d * t;
        let outside = p - p.clamp(-half, half);
        outside.dot(d)
    };
    if slope(0.0) >= 0.0 {
        return at(0.0).length();
    }
    if slope(1.0) <= 0.0 {
        return at(1.0).length();
    }
    // Between two breaks the slope is linear: its root follows from the last break below zero and the first above.
    let (mut low, mut high) = (0.0, 1.0);
    let (mut slope_low, mut slope_high) = (slope(0.0), slope(1.0));
    for (p, v, h) in [(a.x, d.x, half.x), (a.y, d.y, half.y), (a.z, d.z, half.z)] {
        if v == 0.0 {
            continue;
        }
        for t in [(-h - p) / v, (h - p) / v] {
            if t > low && t < high {
                let s = slope(t);
                if s <= 0.0 {
                    (low, slope_low) = (t, s);
                } else {
                    (high, slope_high) = (t, s);
                }
            }
        }
    }
    let rise = slope_high - slope_low;
    let t = if rise > 0.0 { low - slope_low * (high - low) / rise } else { low };
    at(t.clamp(low, high)).length()
}
