//! Triangles of a mesh as a tree of boxes, and whether they are within a distance of other triangles or of something
//! convex: exact, also where surfaces cross.

use glamx::{DAffine3, DMat3, DVec3};
use smallvec::{SmallVec, smallvec};

use super::pairs::box_box;
use super::triangle_pair::{apart_by_plane, closest_point, closest_points, distance_squared};

/// A triangle: its corners [m].
pub type Triangle = [DVec3; 3];

/// Triangles per leaf.
const LEAF: usize = 2;

/// Triangles, sorted so that each node of the tree is a range of them.
#[derive(Debug, Clone, PartialEq)]
pub struct Triangles {
    all: Vec<Triangle>,
    nodes: Vec<Node>,
}

/// A box around triangles, along the axes of the mesh.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Node {
    middle: DVec3,
    half: DVec3,
    /// Of an inner node the index of its first half, of a leaf that of its first triangle.
    first: u32,
    /// Number of triangles of a leaf; 0: an inner node.
    count: u32,
}

impl Triangles {
    /// Builds the tree.
    pub fn new(all: impl Iterator<Item = Triangle>) -> Self {
        let mut made = Self { all: all.collect(), nodes: Vec::new() };
        if !made.all.is_empty() {
            let mut all = std::mem::take(&mut made.all);
            made.nodes.push(around(&all));
            made.split(0, &mut all, 0);
            made.all = all;
        }
        made
    }

    fn split(&mut self, node: usize, part: &mut [Triangle], start: usize) {
        if part.len() <= LEAF {
            (self.nodes[node].first, self.nodes[node].count) = (start as u32, part.len() as u32);
            return;
        }
        let center = |t: &Triangle| t[0] + t[1] + t[2];
        let (low, high) = part
            .iter()
            .fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), t| (low.min(center(t)), high.max(center(t))));
        let axis = (high - low).max_position();
        let middle = part.len() / 2;
        part.select_nth_unstable_by(middle, |a, b| center(a)[axis].total_cmp(&center(b)[axis]));
        let (left, right) = part.split_at_mut(middle);
        let first = self.nodes.len();
        self.nodes[node].first = first as u32;
        self.nodes.extend([around(left), around(right)]);
        self.split(first, left, start);
        self.split(first + 1, right, start + middle);
    }

    /// Returns the middle and half extents of the box around all [m].
    pub fn bounds(&self) -> (DVec3, DVec3) {
        self.nodes.first().map_or((DVec3::ZERO, DVec3::ZERO), |root| (root.middle, root.half))
    }

    /// Returns the triangles [m].
    pub fn all(&self) -> &[Triangle] {
        &self.all
    }

    fn leaf(&self, node: &Node) -> &[Triangle] {
        &self.all[node.first as usize..(node.first + node.count) as usize]
    }

    /// Returns the distance of the triangles from something, at most `cutoff` [m]. `apart` returns a lower bound for
    /// the box around some triangles, given by its middle and half extents; `distance` that of a triangle, up to what
    /// is asked for. Ends at any distance up to `enough`.
    pub fn distance(
        &self,
        apart: impl Fn(DVec3, DVec3) -> f64,
        distance: impl Fn(&Triangle, f64) -> f64,
        enough: f64,
        cutoff: f64,
    ) -> f64 {
        let mut best = cutoff;
        let mut open: SmallVec<[u32; 64]> = if self.nodes.is_empty() { smallvec![] } else { smallvec![0] };
        while let Some(at) = open.pop() {
            let node = &self.nodes[at as usize];
            if apart(node.middle, node.half) > best {
                continue;
            }
            if node.count == 0 {
                open.extend([node.first, node.first + 1]);
                continue;
            }
            for triangle in self.leaf(node) {
                best = best.min(distance(triangle, best));
            }
            if best <= enough {
                break;
            }
        }
        best
    }

    /// Returns the distance from others, which are at a pose in this frame, at most `cutoff` [m]. Ends at any distance
    /// up to `enough`.
    pub fn distance_from(&self, others: &Self, pose: &DAffine3, enough: f64, cutoff: f64) -> f64 {
        let mut best = cutoff;
        if self.nodes.is_empty() || others.nodes.is_empty() {
            return best;
        }
        let turned = Turned::new(pose);
        let gap = |i: u32, j: u32| turned.gap(&self.nodes[i as usize], &others.nodes[j as usize]);
        let mut open: SmallVec<[(f64, u32, u32); 128]> = smallvec![(gap(0, 0), 0, 0)];
        while let Some((least, i, j)) = open.pop() {
            if least > best {
                continue;
            }
            let (one, two) = (&self.nodes[i as usize], &others.nodes[j as usize]);
            let Some([(i, j), (k, l)]) = halves((one, i), (two, j)) else {
                for two in others.leaf(two) {
                    let two = [0, 1, 2].map(|i| pose.transform_point3(two[i]));
                    let (low, high) = (two[0].min(two[1]).min(two[2]), two[0].max(two[1]).max(two[2]));
                    for one in self.leaf(one) {
                        // Most are apart along an axis.
                        let (bottom, top) = (one[0].min(one[1]).min(one[2]), one[0].max(one[1]).max(one[2]));
                        if (bottom - high).max(low - top).max_element() > best {
                            continue;
                        }
                        if !apart_by_plane(one, &two, best) && !apart_by_plane(&two, one, best) {
                            best = best.min(distance_squared(one, &two).sqrt());
                        }
                    }
                }
                if best <= enough {
                    break;
                }
                continue;
            };
            let (first, second) = ((gap(i, j), i, j), (gap(k, l), k, l));
            // The nearer one is seen first.
            let both = if first.0 < second.0 { [second, first] } else { [first, second] };
            open.extend(both.into_iter().filter(|(least, ..)| *least <= best));
        }
        best
    }

    /// Returns the closest points of the triangles and of others, which are at a pose in this frame; `None` if either
    /// has none.
    pub fn nearest(&self, others: &Self, pose: &DAffine3) -> Option<[DVec3; 2]> {
        let turned = Turned::new(pose);
        let gap = |i: u32, j: u32| turned.gap(&self.nodes[i as usize], &others.nodes[j as usize]);
        let (mut best, mut found) = (f64::INFINITY, None);
        let mut open: Vec<(f64, u32, u32)> = Vec::new();
        if !self.nodes.is_empty() && !others.nodes.is_empty() {
            open.push((gap(0, 0), 0, 0));
        }
        while let Some((least, i, j)) = open.pop() {
            if least >= best {
                continue;
            }
            let (one, two) = (&self.nodes[i as usize], &others.nodes[j as usize]);
            let Some(halves) = halves((one, i), (two, j)) else {
                for b in others.leaf(two).iter().map(|b| b.map(|p| pose.transform_point3(p))) {
                    for a in self.leaf(one) {
                        let points = closest_points(a, &b);
                        let distance = points[0].distance(points[1]);
                        if distance < best {
                            (best, found) = (distance, Some(points));
                        }
                    }
                }
                continue;
            };
            let mut halves = halves.map(|(i, j)| (gap(i, j), i, j));
            // The nearer one is seen first.
            halves.sort_by(|a, b| b.0.total_cmp(&a.0));
            open.extend(halves);
        }
        found
    }

    /// Returns the point of the triangles that is closest to a point; the point itself if there are none.
    pub fn closest(&self, p: DVec3) -> DVec3 {
        let mut best = (f64::INFINITY, p);
        let outside = |node: &Node| ((p - node.middle).abs() - node.half).max(DVec3::ZERO).length_squared();
        let mut open: SmallVec<[(f64, u32); 64]> = smallvec![];
        open.extend(self.nodes.first().map(|root| (outside(root), 0)));
        while let Some((least, at)) = open.pop() {
            if least >= best.0 {
                continue;
            }
            let node = &self.nodes[at as usize];
            if node.count == 0 {
                let mut halves = [node.first, node.first + 1].map(|half| (outside(&self.nodes[half as usize]), half));
                // The nearer one is seen first.
                halves.sort_by(|a, b| b.0.total_cmp(&a.0));
                open.extend(halves);
                continue;
            }
            for triangle in self.leaf(node) {
                let found = closest_point(triangle, p);
                let squared = found.distance_squared(p);
                if squared < best.0 {
                    best = (squared, found);
                }
            }
        }
        best.1
    }
}

fn around(part: &[Triangle]) -> Node {
    let (middle, half) = super::shape::bounds(part.iter().flatten().copied());
    Node { middle, half, first: 0, count: 0 }
}

/// Returns the pairs of nodes that replace a pair: the larger one by its halves; `None` for two leaves.
fn halves((one, i): (&Node, u32), (two, j): (&Node, u32)) -> Option<[(u32, u32); 2]> {
    match (one.count, two.count) {
        (0, n) if n != 0 || one.half.max_element() >= two.half.max_element() => {
            Some([(one.first, j), (one.first + 1, j)])
        }
        (_, 0) => Some([(i, two.first), (i, two.first + 1)]),
        _ => None,
    }
}

/// A pose, prepared for boxes of a tree that is there.
struct Turned {
    pose: DAffine3,
    /// Absolute values of the rotation, rounded up.
    size: DMat3,
}

impl Turned {
    fn new(pose: &DAffine3) -> Self {
        let up = |v: DVec3| v.abs() + DVec3::splat(1e-12);
        let m = &pose.matrix3;
        Self { pose: *pose, size: DMat3::from_cols(up(m.x_axis), up(m.y_axis), up(m.z_axis)) }
    }

    /// Returns a lower bound of the distance of two boxes [m]; most are decided by the axes of their faces.
    fn gap(&self, one: &Node, two: &Node) -> f64 {
        let apart = self.pose.transform_point3(two.middle) - one.middle;
        // The distance of the boxes around both, along the axes of the one and along those of the other.
        let here = (apart.abs() - one.half - self.size * two.half).max(DVec3::ZERO);
        let back = self.pose.matrix3.transpose() * apart;
        let there = (back.abs() - two.half - self.size.transpose() * one.half).max(DVec3::ZERO);
        here.length_squared().max(there.length_squared()).sqrt()
    }
}

/// Returns a lower bound of the distance of a box along the axes of a mesh from another box, given by its frame and
/// half extents in the mesh's frame [m].
pub(super) fn gap_to_box(middle: DVec3, half: DVec3, frame: &DAffine3, other: DVec3) -> f64 {
    box_box::gap(&DAffine3::from_translation(middle), half, frame, other)
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_robot::random::Random;
    use glamx::DQuat;

    /// Triangles of a bumpy ball.
    fn ball(random: &mut Random, number: usize) -> Vec<Triangle> {
        let mut point = || DVec3::new(random.between(-1.0, 1.0), random.between(-1.0, 1.0), random.between(-1.0, 1.0));
        (0..number)
            .map(|_| {
                let at = point().normalize_or(DVec3::X) * 0.1;
                [at, at + point() * 0.02, at + point() * 0.02]
            })
            .collect()
    }

    #[test]
    fn the_tree_finds_what_every_pair_of_triangles_says() {
        let mut random = Random::new(5);
        let (mut near, mut far) = (0, 0);
        for _ in 0..60 {
            let (one, two) = (ball(&mut random, 80), ball(&mut random, 50));
            let axis = DVec3::new(random.unit(), random.unit(), random.unit()).normalize_or(DVec3::Z);
            let place = DVec3::new(random.between(0.0, 0.3), random.between(0.0, 0.3), 0.0);
            let pose =
                DAffine3::from_rotation_translation(DQuat::from_axis_angle(axis, random.between(-3.0, 3.0)), place);
            let placed = two.iter().map(|t| t.map(|p| pose.transform_point3(p)));
            let least = placed
                .flat_map(|b| one.iter().map(move |a| distance_squared(a, &b)))
                .fold(f64::INFINITY, f64::min)
                .sqrt();
            let (a, b) = (Triangles::new(one.iter().copied()), Triangles::new(two.iter().copied()));
            for part in [0.5, 0.99, 1.01, 1.5] {
                let found = a.distance_from(&b, &pose, 0.0, least * part);
                assert!((found - least * f64::min(part, 1.0)).abs() < 1e-12, "{least} {part}");
                assert!((b.distance_from(&a, &pose.inverse(), 0.0, least * part) - found).abs() < 1e-12);
            }
            (near, far) = (near + u32::from(least == 0.0), far + u32::from(least > 0.0));
            let [p, q] = a.nearest(&b, &pose).unwrap();
            assert!((p.distance(q) - least).abs() < 1e-12);
            let p = place * 0.7;
            let nearest = one.iter().map(|t| closest_point(t, p).distance(p)).fold(f64::INFINITY, f64::min);
            assert!((a.closest(p).distance(p) - nearest).abs() < 1e-12);
        }
        assert!(near > 5 && far > 5, "{near} {far}");
        let none = Triangles::new(std::iter::empty());
        assert_eq!(none.distance_from(&none, &DAffine3::IDENTITY, 0.0, 1.0), 1.0);
    }
}
