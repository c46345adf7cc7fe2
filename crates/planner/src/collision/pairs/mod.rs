//! Distances between two cores, one file per pair of kinds. Closed forms where they exist; the general method of
//! `general.rs` is ten times slower.

pub mod box_box;
pub mod general;
pub mod point;
pub mod segment_box;
pub mod segment_segment;

use glamx::{DAffine3, DVec3};

pub use super::shape::Placed;

/// Returns the distance of two cores [m], 0 if they overlap. Radii are not included.
pub fn distance(a: &Placed, b: &Placed) -> f64 {
    use Placed::{Box, Cylinder, Point, Segment};
    match (a, b) {
        (Point(p), Point(q)) => p.distance(*q),
        (Point(p), Segment(s, t)) | (Segment(s, t), Point(p)) => point::segment(*p, *s, *t),
        (Point(p), Box(f, h)) | (Box(f, h), Point(p)) => point::cuboid(*p, f, *h),
        (Point(p), Cylinder(f, h, r)) | (Cylinder(f, h, r), Point(p)) => point::cylinder(*p, f, *h, *r),
        (Segment(a, b), Segment(c, d)) => segment_segment::distance(*a, *b, *c, *d),
        (Segment(a, b), Box(f, h)) | (Box(f, h), Segment(a, b)) => segment_box::distance(*a, *b, f, *h),
        _ => general::distance(a, b),
    }
}

/// Returns whether two cores are within `reach` [m] of each other.
pub fn within(a: &Placed, b: &Placed, reach: f64) -> bool {
    use Placed::{Box, Point, Segment};
    match (a, b) {
        (Box(f, h), Box(g, k)) => {
            let gap = box_box::gap(f, *h, g, *k);
            gap <= reach && (gap <= 0.0 || general::within(a, b, reach))
        }
        (Point(_) | Segment(..) | Box(..), Point(_) | Segment(..) | Box(..)) => distance(a, b) <= reach,
        (Point(_), Placed::Cylinder(..)) | (Placed::Cylinder(..), Point(_)) => distance(a, b) <= reach,
        // Bounding boxes exclude most pairs at a tenth of the cost.
        _ => gap(a, b) <= reach && general::within(a, b, reach),
    }
}

/// Returns a lower bound of the distance of two cores [m], from their bounding boxes: fast.
pub fn gap(a: &Placed, b: &Placed) -> f64 {
    match (a.guard(), b.guard()) {
        (Some((f, h)), Some((g, k))) => box_box::gap(&f, h, &g, k),
        (Some((f, h)), None) => gap_to(b, &f, h),
        (None, Some((f, h))) => gap_to(a, &f, h),
        (None, None) => distance(a, b),
    }
}

fn gap_to(a: &Placed, frame: &DAffine3, half: DVec3) -> f64 {
    match a {
        Placed::Point(p) => point::cuboid(*p, frame, half),
        Placed::Segment(p, q) => segment_box::distance(*p, *q, frame, half),
        _ => 0.0,
    }
}

#[cfg(test)]
mod tests;
