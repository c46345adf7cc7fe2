//! A tree of configurations in flat arrays; the nearest one by a plain scan. Trees of these searches are small (some
//! tens of nodes, seldom some thousands), where a scan is faster than any index.

use std::f64::consts::TAU;

/// A tree: nodes, their parents, and how far around each node samples are taken.
#[derive(Debug, Clone, Default)]
pub struct Tree {
    dof: usize,
    turns: Vec<bool>,
    values: Vec<f64>,
    parents: Vec<u32>,
    /// Samples farther than this are not joined to the node [rad] (dynamic domain).
    radii: Vec<f64>,
}

/// The parent of a root.
const ROOT: u32 = u32::MAX;

impl Tree {
    /// An empty tree, for joints of which some turn without end.
    pub fn new(turns: &[bool]) -> Self {
        Self { dof: turns.len(), turns: turns.to_vec(), ..Self::default() }
    }

    /// Number of nodes.
    pub fn len(&self) -> usize {
        self.parents.len()
    }

    /// Whether there are no nodes.
    pub fn is_empty(&self) -> bool {
        self.parents.is_empty()
    }

    /// The configuration of a node.
    pub fn node(&self, i: usize) -> &[f64] {
        self.values.get(i * self.dof..(i + 1) * self.dof).unwrap_or_default()
    }

    /// How far around a node samples are taken [rad].
    pub fn radius(&self, i: usize) -> f64 {
        self.radii.get(i).copied().unwrap_or(f64::INFINITY)
    }

    /// Changes that.
    pub fn set_radius(&mut self, i: usize, radius: f64) {
        if let Some(r) = self.radii.get_mut(i) {
            *r = radius;
        }
    }

    /// Adds a node, a root without a parent; returns its index.
    pub fn add(&mut self, q: &[f64], parent: Option<usize>) -> usize {
        self.values.extend_from_slice(q);
        self.parents.push(parent.map_or(ROOT, |p| p as u32));
        self.radii.push(f64::INFINITY);
        self.parents.len() - 1
    }

    /// The node nearest to a configuration, and its distance [rad].
    pub fn nearest(&self, q: &[f64]) -> (usize, f64) {
        if self.turns.contains(&true) {
            return self.nearest_around(q);
        }
        let mut best = (0, f64::INFINITY);
        for (i, node) in self.values.chunks_exact(self.dof.max(1)).enumerate() {
            let squared: f64 = node.iter().zip(q).map(|(a, b)| (a - b) * (a - b)).sum();
            if squared < best.1 {
                best = (i, squared);
            }
        }
        (best.0, best.1.sqrt())
    }

    /// The same with joints that turn without end: the short way round counts.
    fn nearest_around(&self, q: &[f64]) -> (usize, f64) {
        let apart = |((a, b), turns): ((&f64, &f64), &bool)| {
            let d = a - b;
            if *turns { d - (d / TAU).round() * TAU } else { d }
        };
        let mut best = (0, f64::INFINITY);
        for (i, node) in self.values.chunks_exact(self.dof.max(1)).enumerate() {
            let squared: f64 = node.iter().zip(q).zip(&self.turns).map(apart).map(|d| d * d).sum();
            if squared < best.1 {
                best = (i, squared);
            }
        }
        (best.0, best.1.sqrt())
    }

    /// The configurations from a node up to its root.
    pub fn way_up(&self, node: usize) -> impl Iterator<Item = &[f64]> {
        let up = |i: &usize| self.parents.get(*i).filter(|p| **p != ROOT).map(|p| *p as usize);
        std::iter::successors(Some(node), up).map(|i| self.node(i))
    }
}
