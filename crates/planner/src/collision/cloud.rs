//! Point cloud as a tree of bounding boxes: an obstacle of many small balls.

use glamx::{DAffine3, DVec3};

use super::pairs::point::local;

/// Points per leaf.
const LEAF: usize = 4;
/// Halves with more points than these are sorted at the same time.
const MANY: usize = 200_000;

/// Points, sorted so that each node of the tree is a range of them.
#[derive(Debug, Clone, PartialEq)]
pub struct Cloud {
    points: Vec<DVec3>,
    /// A binary heap of boxes (lowest, highest corner): node `i` has children `2i + 1` and `2i + 2`.
    boxes: Vec<(DVec3, DVec3)>,
    depth: u32,
}

impl Cloud {
    /// Builds a tree of points [m]; drops points that are not finite, returns `None` if none remain.
    pub fn new(points: impl IntoIterator<Item = DVec3>) -> Option<Self> {
        let mut points: Vec<DVec3> = points.into_iter().filter(|p| p.is_finite()).collect();
        if points.is_empty() {
            return None;
        }
        let depth = points.len().div_ceil(LEAF).next_power_of_two().trailing_zeros();
        sort(&mut points, depth);
        let mut boxes = vec![(DVec3::INFINITY, DVec3::NEG_INFINITY); (2 << depth) - 1];
        bound(&points, 0, &mut boxes);
        Some(Self { points, boxes, depth })
    }

    /// Returns the number of points.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Returns whether there are no points: never.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// Returns the points [m], in the cloud's frame.
    pub fn points(&self) -> &[DVec3] {
        &self.points
    }

    /// Returns the lowest and highest corner of the bounding box.
    pub fn bounds(&self) -> (DVec3, DVec3) {
        self.boxes[0]
    }

    /// Returns whether `test` holds for any point within `reach` of a ball; points are passed in the common frame.
    pub fn any_within(
        &self,
        frame: &DAffine3,
        ball: DVec3,
        radius: f64,
        reach: f64,
        mut test: impl FnMut(DVec3) -> bool,
    ) -> bool {
        let center = local(ball, frame);
        self.visit(0, 0..self.points.len(), &mut |node, points| {
            let near = |p: DVec3, limit: f64| p.length_squared() <= limit * limit;
            if let Some((low, high)) = node {
                return near(center - center.clamp(low, high), radius + reach);
            }
            points.iter().any(|p| near(*p - center, radius + reach) && test(frame.transform_point3(*p)))
        })
    }

    /// Returns the smallest `distance` of a point, and the point, in the common frame. The other solid is inside the
    /// ball.
    pub fn nearest(
        &self,
        frame: &DAffine3,
        ball: DVec3,
        radius: f64,
        mut distance: impl FnMut(DVec3) -> f64,
    ) -> (f64, DVec3) {
        let center = local(ball, frame);
        let mut best = (f64::INFINITY, frame.transform_point3(self.points[0]));
        self.visit(0, 0..self.points.len(), &mut |node, points| {
            if let Some((low, high)) = node {
                return (center - center.clamp(low, high)).length() - radius < best.0;
            }
            for p in points {
                if (*p - center).length() - radius < best.0 {
                    let p = frame.transform_point3(*p);
                    let d = distance(p);
                    if d < best.0 {
                        best = (d, p);
                    }
                }
            }
            false
        });
        best
    }

    /// Walks the tree: `see` decides for each box whether to descend, and for each leaf whether to end.
    fn visit(
        &self,
        node: usize,
        range: std::ops::Range<usize>,
        see: &mut impl FnMut(Option<(DVec3, DVec3)>, &[DVec3]) -> bool,
    ) -> bool {
        if range.is_empty() || !see(Some(self.boxes[node]), &[]) {
            return false;
        }
        if 2 * node + 1 >= self.boxes.len() {
            return see(None, &self.points[range]);
        }
        let middle = range.start + range.len() / 2;
        self.visit(2 * node + 1, range.start..middle, see) || self.visit(2 * node + 2, middle..range.end, see)
    }
}

/// Sorts points into halves along the longest side, and these again, `depth` times.
fn sort(points: &mut [DVec3], depth: u32) {
    if depth == 0 || points.is_empty() {
        return;
    }
    let (low, high) = corners(points);
    let axis = (high - low).max_position();
    let middle = points.len() / 2;
    points.select_nth_unstable_by(middle, |a, b| a[axis].total_cmp(&b[axis]));
    let (left, right) = points.split_at_mut(middle);
    if left.len() < MANY {
        sort(left, depth - 1);
        sort(right, depth - 1);
        return;
    }
    std::thread::scope(|scope| {
        scope.spawn(|| sort(left, depth - 1));
        sort(right, depth - 1);
    });
}

fn corners(points: &[DVec3]) -> (DVec3, DVec3) {
    points.iter().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), p| (low.min(*p), high.max(*p)))
}

/// Fills the boxes of a node of sorted points and of all below it.
fn bound(points: &[DVec3], node: usize, boxes: &mut [(DVec3, DVec3)]) -> (DVec3, DVec3) {
    let found = if 2 * node + 1 >= boxes.len() {
        corners(points)
    } else {
        let (left, right) = points.split_at(points.len() / 2);
        let (a, b) = (bound(left, 2 * node + 1, boxes), bound(right, 2 * node + 2, boxes));
        (a.0.min(b.0), a.1.max(b.1))
    };
    boxes[node] = found;
    found
}
