//! Two segments: closest points by clamping one parameter after the other (Ericson, "Real-Time Collision Detection",
//! 2005, section 5.1.9).

use glamx::DVec3;

/// Returns the distance of segment `a`–`b` from segment `c`–`d` [m].
pub fn distance(a: DVec3, b: DVec3, c: DVec3, d: DVec3) -> f64 {
    let (u, v, w) = (b - a, d - c, a - c);
    let (uu, uv, vv) = (u.length_squared(), u.dot(v), v.length_squared());
    let (uw, vw) = (u.dot(w), v.dot(w));
    if uu <= f64::EPSILON && vv <= f64::EPSILON {
        return w.length();
    }
    let unit = |x: f64| x.clamp(0.0, 1.0);
    let (s, t);
    if uu <= f64::EPSILON {
        (s, t) = (0.0, unit(vw / vv));
    } else if vv <= f64::EPSILON {
        (s, t) = (unit(-uw / uu), 0.0);
    } else {
        let det = uu * vv - uv * uv;
        // Parallel segments: start from any point, the clamping below finds its partner.
        let first = if det > 1e-14 * uu * vv { unit((uv * vw - uw * vv) / det) } else { 0.0 };
        let other = (uv * first + vw) / vv;
        t = unit(other);
        s = if other == t { first } else { unit((uv * t - uw) / uu) };
    }
    (w + u * s - v * t).length()
}
