//! Covers: trees of balls that contain a solid. A point farther from all balls than a margin is farther from the solid.
//!
//! The proof needs no samples: a solid is halved into boxes, and the ball of each box contains the extreme points of
//! the part that is in it, hence the part. The ball of a convex solid's part is the one that is least outside of the
//! solid: a slice of a cylinder gets a ball about the axis, hardly larger than the cylinder.

mod ball;
mod cell;
mod vector;

use std::collections::BinaryHeap;

pub use cell::{Depth, Inside};

use ball::{Ball, Plane};
use cell::Cell;
use vector::{Vector, bounds, cross, direction, dot, sub};

/// A part is not halved further if its ball is outside of the solid by no more than this [m].
const OVERSHOOT: f64 = 0.002;
/// The same of a solid that need not be convex: what covers do not prove is for its triangles [m].
const OVERSHOOT_OF_MESH: f64 = 0.001;
/// Largest number of balls that are not halved further, per solid.
const LEAVES: usize = 192;
/// The same of a solid that need not be convex.
const LEAVES_OF_MESH: usize = 1600;
/// Points per leaf of a cloud.
const POINTS: usize = 4;
/// Rounding to single precision [relative to a coordinate].
const ROUNDING: f64 = 2e-7;

/// A ball of a tree.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Node {
    /// Its centre [m].
    pub center: [f32; 3],
    /// Its radius [m].
    pub radius: f32,
    /// Radius of a ball about the same centre that is inside the solid [m]; negative if none is known.
    pub inner: f32,
    /// Index of the first of its parts, which follow each other.
    pub first: u32,
    /// Number of its parts: balls that together contain what it contains of the solid; 0: none.
    pub count: u32,
}

/// Balls around a solid and its parts; the first contains all.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Tree {
    /// The balls.
    pub nodes: Vec<Node>,
}

/// The place of a solid in its link.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// Columns of the rotation.
    pub rotation: [[f64; 3]; 3],
    /// Position [m].
    pub translation: [f64; 3],
    /// Addition to every radius [m].
    pub radius: f64,
}

impl Tree {
    /// Covers a solid, given by the triangles of its surface [m] and what is inside.
    pub fn of_triangles(triangles: impl Iterator<Item = [[f64; 3]; 3]>, inside: Inside<'_>) -> Self {
        let polygons: Vec<Vec<Vector>> = triangles.map(Vec::from).collect();
        if polygons.is_empty() {
            return Self::default();
        }
        let planes = if matches!(inside, Inside::Convex) { planes(&polygons) } else { Vec::new() };
        let (low, high) = bounds(polygons.iter().flatten().copied());
        let mut nodes = Vec::new();
        let Some(root) = Cell::new(polygons, low, high, &planes, inside) else { return Self::default() };
        nodes.push(root.node());
        let mut open = BinaryHeap::from([Open { at: 0, cell: root }]);
        let is_mesh = matches!(inside, Inside::Depth(_));
        let (most, overshoot) = if is_mesh { (LEAVES_OF_MESH, OVERSHOOT_OF_MESH) } else { (LEAVES, OVERSHOOT) };
        let mut leaves = 1;
        while leaves < most && open.peek().is_some_and(|worst| worst.cell.overshoot > overshoot) {
            let Some(Open { at, cell }) = open.pop() else { break };
            let first = nodes.len();
            for part in cell.halves(&planes, inside).into_iter().flatten() {
                open.push(Open { at: nodes.len(), cell: part.clone() });
                nodes.push(part.node());
            }
            (nodes[at].first, nodes[at].count) = (first as u32, (nodes.len() - first) as u32);
            leaves += nodes.len() - first - 1;
        }
        Self { nodes }
    }

    /// Covers a segment from `-half` to `half` on the z axis [m].
    pub fn of_segment(half: f64) -> Self {
        let edge = [[0.0, 0.0, -half], [0.0, 0.0, half], [0.0, 0.0, half]];
        Self::of_triangles(std::iter::once(edge), Inside::Nothing)
    }

    /// Covers a point at the origin.
    pub fn of_point() -> Self {
        Self { nodes: vec![node(&Ball { center: [0.0; 3], radius: 0.0 }, 0.0)] }
    }

    /// Covers points [m] that are sorted so that those of a half, of its halves, and so on, are close to each other.
    pub fn of_sorted_points<P: Copy + Into<[f64; 3]>>(points: &[P]) -> Self {
        let mut nodes = vec![node(&Ball { center: [0.0; 3], radius: 0.0 }, NONE)];
        if points.is_empty() {
            return Self::default();
        }
        halve(points, 0, &mut nodes);
        Self { nodes }
    }

    /// Joins the covers of the solids of one link, each at its place.
    pub fn join(parts: &[(&Self, Place)]) -> Self {
        let mut placed: Vec<(Ball, &Self, Place)> = Vec::new();
        for (tree, place) in parts {
            let Some(root) = tree.nodes.first() else { continue };
            placed.push((moved(root, place).0, *tree, *place));
        }
        let mut joined = Self::default();
        if !placed.is_empty() {
            joined.nodes.push(around_all(&placed));
            joined.add(0, &mut placed);
        }
        joined
    }

    fn add(&mut self, at: usize, parts: &mut [(Ball, &Self, Place)]) {
        if let [(_, tree, place)] = parts {
            let (ball, inner) = moved(&tree.nodes[0], place);
            self.nodes[at] = node(&ball, inner);
            self.copy(at, tree, 0, place);
            return;
        }
        let (low, high) = bounds(parts.iter().map(|p| p.0.center));
        let axis = longest(low, high);
        parts.sort_by(|a, b| a.0.center[axis].total_cmp(&b.0.center[axis]));
        let (left, right) = parts.split_at_mut(parts.len() / 2);
        let first = self.nodes.len();
        (self.nodes[at].first, self.nodes[at].count) = (first as u32, 2);
        for half in [&left, &right] {
            self.nodes.push(around_all(half));
        }
        self.add(first, left);
        self.add(first + 1, right);
    }

    /// Copies the parts of a ball of another tree to a ball of this one.
    fn copy(&mut self, at: usize, tree: &Self, from: usize, place: &Place) {
        let Node { first, count, .. } = tree.nodes[from];
        let new = self.nodes.len();
        (self.nodes[at].first, self.nodes[at].count) = (new as u32, count);
        for i in 0..count as usize {
            let (ball, inner) = moved(&tree.nodes[first as usize + i], place);
            self.nodes.push(node(&ball, inner));
        }
        for i in 0..count as usize {
            self.copy(new + i, tree, first as usize + i, place);
        }
    }
}

/// A part that may be halved; the one that is outside of its solid most comes first.
struct Open {
    at: usize,
    cell: Cell,
}

impl PartialEq for Open {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Open {}

impl PartialOrd for Open {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Open {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.cell.overshoot.total_cmp(&other.cell.overshoot).then(other.at.cmp(&self.at))
    }
}

/// Returns the planes of a convex surface, each once; normals point outwards whatever the order of the corners.
fn planes(triangles: &[Vec<Vector>]) -> Vec<Plane> {
    let corners: Vec<Vector> = triangles.iter().flatten().copied().collect();
    let number = corners.len().max(1) as f64;
    let middle: Vector = std::array::from_fn(|i| corners.iter().map(|p| p[i]).sum::<f64>() / number);
    let mut planes: Vec<Plane> = Vec::new();
    for triangle in triangles {
        let [a, b, c] = triangle[..] else { continue };
        let mut normal = direction(cross(sub(b, a), sub(c, a)));
        if dot(normal, sub(a, middle)) < 0.0 {
            normal = normal.map(|x| -x);
        }
        // Farther out than any corner: the surface may be a little dented by rounding.
        let offset = corners.iter().map(|p| dot(normal, *p)).fold(f64::NEG_INFINITY, f64::max);
        let same = |p: &Plane| dot(p.normal, normal) > 1.0 - 1e-9 && (p.offset - offset).abs() < 1e-7;
        if dot(normal, normal) > 0.5 && !planes.iter().any(same) {
            planes.push(Plane { normal, offset });
        }
    }
    planes
}

/// Covers the halves of sorted points, down to the leaves, then all of them. Returns their ball and their box.
fn halve<P: Copy + Into<[f64; 3]>>(points: &[P], at: usize, nodes: &mut Vec<Node>) -> (Ball, [Vector; 2]) {
    let middle = |low: Vector, high: Vector| std::array::from_fn(|i| 0.5 * (low[i] + high[i]));
    if points.len() <= POINTS {
        let (low, high) = bounds(points.iter().map(|p| (*p).into()));
        let center = middle(low, high);
        let radius = points.iter().map(|p| vector::distance((*p).into(), center)).fold(0.0, f64::max);
        let ball = Ball { center, radius };
        nodes[at] = node(&ball, if points.len() == 1 { 0.0 } else { NONE });
        return (ball, [low, high]);
    }
    let first = nodes.len();
    nodes.extend([nodes[at]; 2]);
    let (left, right) = points.split_at(points.len() / 2);
    let (a, [a_low, a_high]) = halve(left, first, nodes);
    let (b, [b_low, b_high]) = halve(right, first + 1, nodes);
    let low = std::array::from_fn(|i| a_low[i].min(b_low[i]));
    let high = std::array::from_fn(|i| a_high[i].max(b_high[i]));
    let center = middle(low, high);
    // Both contain all points: the balls of the halves, and the corners of the box.
    let halves = [a, b].map(|half| vector::distance(half.center, center) + half.radius);
    let radius = halves[0].max(halves[1]).min(vector::distance(low, center));
    let ball = Ball { center, radius };
    nodes[at] = node(&ball, NONE);
    (nodes[at].first, nodes[at].count) = (first as u32, 2);
    (ball, [low, high])
}

fn longest(low: Vector, high: Vector) -> usize {
    (0..3).max_by(|a, b| (high[*a] - low[*a]).total_cmp(&(high[*b] - low[*b]))).unwrap_or(0)
}

/// No ball inside the solid is known.
const NONE: f64 = -1.0;

/// Rounds a ball so that it contains the exact one, and the inner one so that it is contained.
fn node(ball: &Ball, inner: f64) -> Node {
    let far = ball.center.iter().map(|x| x.abs()).sum::<f64>() + ball.radius;
    let (radius, inner) =
        ((ball.radius + far * ROUNDING) as f32, if inner < 0.0 { NONE } else { inner - far * ROUNDING });
    Node { center: ball.center.map(|x| x as f32), radius, inner: inner as f32, first: 0, count: 0 }
}

fn around_all(parts: &[(Ball, &Tree, Place)]) -> Node {
    node(&ball::enclosing(&parts.iter().map(|p| p.0).collect::<Vec<_>>()), NONE)
}

/// Returns centre and radius of a ball around balls [m].
pub(crate) fn enclosing(nodes: &[Node]) -> ([f32; 3], f32) {
    let ball = |node: &Node| Ball { center: node.center.map(f64::from), radius: f64::from(node.radius) };
    let all = node(&ball::enclosing(&nodes.iter().map(ball).collect::<Vec<_>>()), NONE);
    (all.center, all.radius)
}

fn moved(node: &Node, place: &Place) -> (Ball, f64) {
    let c = node.center.map(f64::from);
    let [x, y, z] = place.rotation;
    let center = std::array::from_fn(|i| x[i] * c[0] + y[i] * c[1] + z[i] * c[2] + place.translation[i]);
    let inner = if node.inner < 0.0 { NONE } else { f64::from(node.inner) + place.radius };
    (Ball { center, radius: f64::from(node.radius) + place.radius }, inner)
}

#[cfg(test)]
mod tests;
