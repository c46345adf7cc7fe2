//! Distance of two triangles in closed form: between two edges, between a corner and the inside of the other, or zero
//! where an edge of one goes through the other (Ericson, "Real-Time Collision Detection", 2005, 5.1).

use glamx::DVec3;

use super::triangles::Triangle;

/// A cross product shorter than this part of the squared edges spans no plane.
const FLAT: f64 = 1e-12;

/// Returns whether all corners of a triangle are on one side of another's plane and farther from it than `reach` [m]:
/// most pairs are.
pub(super) fn apart_by_plane(plane: &Triangle, other: &Triangle, reach: f64) -> bool {
    let normal = (plane[1] - plane[0]).cross(plane[2] - plane[0]);
    let squared = normal.length_squared();
    let height = |p: DVec3| normal.dot(p - plane[0]);
    let (a, b, c) = (height(other[0]), height(other[1]), height(other[2]));
    let least = if a > 0.0 && b > 0.0 && c > 0.0 {
        a.min(b).min(c)
    } else if a < 0.0 && b < 0.0 && c < 0.0 {
        -a.max(b).max(c)
    } else {
        return false;
    };
    // A little more than the reach: rounding proves nothing.
    least * least > reach * reach * squared * (1.0 + 1e-9) + 1e-24 * squared && squared > 0.0
}

/// Returns the squared distance of two triangles [m²].
pub(super) fn distance_squared(one: &Triangle, two: &Triangle) -> f64 {
    let [p, q] = closest_points(one, two);
    p.distance_squared(q)
}

/// Returns the closest points of two triangles; the same one where they cross.
pub(super) fn closest_points(one: &Triangle, two: &Triangle) -> [DVec3; 2] {
    if let Some(p) = pierces(one, two).or_else(|| pierces(two, one)) {
        return [p; 2];
    }
    let (mut least, mut best) = (f64::INFINITY, [one[0], two[0]]);
    let mut see = |points: [DVec3; 2]| {
        let squared = points[0].distance_squared(points[1]);
        if squared < least {
            (least, best) = (squared, points);
        }
    };
    for i in 0..3 {
        for j in 0..3 {
            see(segments(one[i], one[(i + 1) % 3], two[j], two[(j + 1) % 3]));
        }
    }
    for i in 0..3 {
        if let Some(foot) = foot(one, two[i]) {
            see([foot, two[i]]);
        }
        if let Some(foot) = foot(two, one[i]) {
            see([one[i], foot]);
        }
    }
    best
}

/// Returns where an edge of a triangle goes through another.
fn pierces(edges: &Triangle, through: &Triangle) -> Option<DVec3> {
    let normal = (through[1] - through[0]).cross(through[2] - through[0]);
    let height = |p: DVec3| normal.dot(p - through[0]);
    let heights = [height(edges[0]), height(edges[1]), height(edges[2])];
    (0..3).find_map(|i| {
        let (a, b) = (heights[i], heights[(i + 1) % 3]);
        if a * b > 0.0 || a == b {
            return None;
        }
        let p = edges[i] + (edges[(i + 1) % 3] - edges[i]) * (a / (a - b));
        is_over(through, normal, p).then_some(p)
    })
}

/// Returns whether the foot of a point on a triangle's plane is in the triangle.
fn is_over(triangle: &Triangle, normal: DVec3, p: DVec3) -> bool {
    (0..3).all(|i| {
        let (a, b) = (triangle[i], triangle[(i + 1) % 3]);
        (b - a).cross(p - a).dot(normal) >= 0.0
    })
}

/// Returns the foot of a point on a triangle's plane, if it is in the triangle.
fn foot(triangle: &Triangle, p: DVec3) -> Option<DVec3> {
    let [a, b, c] = *triangle;
    let normal = (b - a).cross(c - a);
    let squared = normal.length_squared();
    let flat = squared <= FLAT * FLAT * (b - a).length_squared() * (c - a).length_squared();
    (!flat && is_over(triangle, normal, p)).then(|| p - normal * (normal.dot(p - a) / squared))
}

/// Returns the closest points of two segments.
fn segments(p: DVec3, q: DVec3, r: DVec3, s: DVec3) -> [DVec3; 2] {
    let (d, e, from) = (q - p, s - r, p - r);
    let (a, c, f) = (d.length_squared(), e.length_squared(), e.dot(from));
    let (b, g) = (d.dot(e), d.dot(from));
    let part = |x: f64, of: f64| if of > 0.0 { (x / of).clamp(0.0, 1.0) } else { 0.0 };
    let across = a * c - b * b;
    let mut t = if across > FLAT * a * c { ((b * f - g * c) / across).clamp(0.0, 1.0) } else { 0.0 };
    let mut u = part(b * t + f, c);
    // Again, for the other is now within its ends.
    t = part(b * u - g, a);
    u = part(b * t + f, c);
    [p + d * t, r + e * u]
}

/// Returns the point of a triangle that is closest to a point.
pub(super) fn closest_point(triangle: &Triangle, p: DVec3) -> DVec3 {
    if let Some(foot) = foot(triangle, p) {
        return foot;
    }
    let [a, b, c] = *triangle;
    let on_edge = |a: DVec3, b: DVec3| {
        let d = b - a;
        let squared = d.length_squared();
        if squared > 0.0 { a + d * ((p - a).dot(d) / squared).clamp(0.0, 1.0) } else { a }
    };
    let edges = [on_edge(a, b), on_edge(b, c), on_edge(c, a)];
    let nearer = |x: DVec3, y: DVec3| if y.distance_squared(p) < x.distance_squared(p) { y } else { x };
    nearer(nearer(edges[0], edges[1]), edges[2])
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_robot::random::Random;

    /// The distance by descent from many starts, of all points of both.
    fn by_search(one: &Triangle, two: &Triangle) -> f64 {
        let mut least = f64::INFINITY;
        for start in 0..7 {
            let mut p = match start {
                0 => (one[0] + one[1] + one[2]) / 3.0,
                1..=3 => one[start - 1],
                _ => 0.5 * (one[start - 4] + one[(start - 3) % 3]),
            };
            for _ in 0..3000 {
                let q = closest_point(two, p);
                p = closest_point(one, q);
                least = least.min(p.distance(q));
            }
        }
        least
    }

    #[test]
    fn the_distance_is_that_of_a_search() {
        let mut random = Random::new(3);
        let mut point = |size: f64, at: DVec3| {
            at + DVec3::new(random.between(-1.0, 1.0), random.between(-1.0, 1.0), random.between(-1.0, 1.0)) * size
        };
        let (mut crossing, mut apart) = (0, 0);
        for k in 0..400 {
            let at = DVec3::X * 0.02 * f64::from(k % 40);
            let one = [point(0.3, DVec3::ZERO), point(0.3, DVec3::ZERO), point(0.3, DVec3::ZERO)];
            let two = [point(0.3, at), point(0.3, at), point(if k % 5 == 0 { 0.001 } else { 0.3 }, at)];
            let (found, searched) = (distance_squared(&one, &two).sqrt(), by_search(&one, &two));
            assert!(found <= searched + 1e-9, "{found} {searched}");
            assert!(searched < found + 2e-3, "{found} {searched}: {one:?} {two:?}");
            assert!((distance_squared(&two, &one).sqrt() - found).abs() < 1e-12);
            for reach in [0.0, 0.9 * found] {
                assert!(found == 0.0 || distance_squared(&one, &two) > reach * reach);
                // A plane separates only what is apart.
                let touching = found == 0.0 && apart_by_plane(&two, &one, reach);
                assert!(!apart_by_plane(&one, &two, found * 1.001 + 1e-12) && !touching);
            }
            (crossing, apart) = (crossing + u32::from(found == 0.0), apart + u32::from(found > 0.0));
        }
        assert!(crossing > 30 && apart > 100, "{crossing} {apart}");
    }

    #[test]
    fn points_and_segments_are_triangles_without_an_area() {
        let triangle = [DVec3::ZERO, DVec3::X, DVec3::Y];
        let above = DVec3::new(0.2, 0.2, 0.5);
        assert!((distance_squared(&triangle, &[above; 3]).sqrt() - 0.5).abs() < 1e-12);
        let beside = [DVec3::new(2.0, 0.0, -1.0), DVec3::new(2.0, 0.0, 1.0), DVec3::new(2.0, 0.0, 1.0)];
        assert!((distance_squared(&beside, &triangle).sqrt() - 1.0).abs() < 1e-12);
        let through = [above, DVec3::new(0.2, 0.2, -0.5), DVec3::new(0.2, 0.2, -0.5)];
        assert_eq!(distance_squared(&through, &triangle), 0.0);
        assert_eq!(distance_squared(&triangle, &triangle), 0.0);
    }
}
