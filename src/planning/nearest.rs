//! A tree of configurations in flat arrays; nearest neighbour by a linear scan. The trees of these searches are small
//! (some tens of nodes, seldom thousands); there, a scan is faster than an index.

use std::f64::consts::TAU;

/// A tree: nodes, their parents, and the sampling radius of each node.
#[derive(Debug, Clone, Default)]
pub struct Tree {
    dof: usize,
    turns: Vec<bool>,
    values: Vec<f64>,
    parents: Vec<u32>,
    /// Samples farther away are not connected to the node [rad] (dynamic domain).
    radii: Vec<f64>,
}

/// Parent index of a root.
const ROOT: u32 = u32::MAX;

impl Tree {
    /// Creates an empty tree; `turns` marks the continuous joints.
    pub fn new(turns: &[bool]) -> Self {
        Self { dof: turns.len(), turns: turns.to_vec(), ..Self::default() }
    }

    /// Returns the number of nodes.
    pub fn len(&self) -> usize {
        self.parents.len()
    }

    /// Returns whether there are no nodes.
    pub fn is_empty(&self) -> bool {
        self.parents.is_empty()
    }

    /// Returns the configuration of a node.
    pub fn node(&self, i: usize) -> &[f64] {
        self.values.get(i * self.dof..(i + 1) * self.dof).unwrap_or_default()
    }

    /// Returns the sampling radius of a node [rad].
    pub fn radius(&self, i: usize) -> f64 {
        self.radii.get(i).copied().unwrap_or(f64::INFINITY)
    }

    /// Sets the sampling radius of a node [rad].
    pub fn set_radius(&mut self, i: usize, radius: f64) {
        if let Some(r) = self.radii.get_mut(i) {
            *r = radius;
        }
    }

    /// Adds a node, a root if it has no parent; returns its index.
    pub fn add(&mut self, q: &[f64], parent: Option<usize>) -> usize {
        self.values.extend_from_slice(q);
        self.parents.push(parent.map_or(ROOT, |p| p as u32));
        self.radii.push(f64::INFINITY);
        self.parents.len() - 1
    }

    /// Returns the node nearest to a configuration, and its distance [rad].
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

    /// Same for trees with continuous joints: measures them the short way round.
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

    /// Returns the configurations from a node up to its root.
    pub fn way_up(&self, node: usize) -> impl Iterator<Item = &[f64]> {
        let up = |i: &usize| self.parents.get(*i).filter(|p| **p != ROOT).map(|p| *p as usize);
        std::iter::successors(Some(node), up).map(|i| self.node(i))
    }
}
