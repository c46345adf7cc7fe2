//! Three numbers of double precision.

/// A point or direction.
pub(super) type Vector = [f64; 3];

pub(super) fn dot(a: Vector, b: Vector) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(super) fn cross(a: Vector, b: Vector) -> Vector {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// `a + s · b`.
pub(super) fn along(a: Vector, s: f64, b: Vector) -> Vector {
    [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]]
}

pub(super) fn sub(a: Vector, b: Vector) -> Vector {
    along(a, -1.0, b)
}

pub(super) fn distance(a: Vector, b: Vector) -> f64 {
    let d = sub(a, b);
    dot(d, d).sqrt()
}

/// The direction of a vector; zero if it has none.
pub(super) fn direction(a: Vector) -> Vector {
    let length = dot(a, a).sqrt();
    if length > 0.0 { a.map(|x| x / length) } else { [0.0; 3] }
}

/// The lowest and highest corner of the bounding box of points.
pub(super) fn bounds(points: impl Iterator<Item = Vector>) -> (Vector, Vector) {
    points.fold(([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]), |(low, high), p| {
        (std::array::from_fn(|i| low[i].min(p[i])), std::array::from_fn(|i| high[i].max(p[i])))
    })
}
