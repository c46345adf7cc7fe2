//! A tree of configurations in flat arrays, and the nodes nearest to sixteen samples at a time.

use dimos_kernels::Width;
use dimos_kernels::block::{LANES, Lanes};
use dimos_kernels::nearest::{Nearest, Nodes};

/// A tree: nodes, their parents, and the sampling radius of each node.
#[derive(Debug, Clone)]
pub struct Tree {
    dof: usize,
    values: Vec<f64>,
    /// The same in single precision, to find the nearest.
    nodes: Nodes,
    parents: Vec<u32>,
    /// Samples farther away are not connected to the node [rad] (dynamic domain).
    radii: Vec<f64>,
}

/// Nodes for which a new tree has room.
const ROOM: usize = 16;

/// Samples nearer to a node than this are none [rad].
const SAME: f64 = 1e-6;

/// Parent index of a root.
const ROOT: u32 = u32::MAX;

impl Tree {
    /// Creates an empty tree; `turns` marks the continuous joints.
    pub fn new(turns: &[bool]) -> Self {
        let nodes = Nodes::new(turns, Width::widest());
        let dof = turns.len();
        let values = Vec::with_capacity(ROOM * dof);
        Self { dof, values, nodes, parents: Vec::with_capacity(ROOM), radii: Vec::with_capacity(ROOM) }
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

    /// Returns whether the sample of a lane is in the domain of the node nearest to it, and not at the node.
    pub fn is_in_domain(&self, nearest: &Nearest, lane: usize) -> bool {
        let (radius, squared) = (self.radius(nearest.node(lane)), f64::from(nearest.squared.0[lane]));
        squared <= radius * radius && squared > SAME * SAME
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
        self.nodes.add(q);
        self.parents.push(parent.map_or(ROOT, |p| p as u32));
        self.radii.push(f64::INFINITY);
        self.parents.len() - 1
    }

    /// Removes a node and all that grew from it: no sample is connected to them any longer.
    pub fn remove(&mut self, node: usize) {
        // A node comes after its parent.
        let mut removed = vec![false; self.len()];
        for i in node..self.len() {
            removed[i] = i == node || self.parent(i).is_some_and(|parent| removed[parent]);
            if removed[i] {
                self.nodes.remove(i);
            }
        }
    }

    /// Returns the node nearest to a configuration, continuous joints the short way round, and its distance [rad].
    pub fn nearest(&self, q: &[f64]) -> (usize, f64) {
        let (node, squared) = self.nodes.nearest(q);
        (node, f64::from(squared).sqrt())
    }

    /// Compares the nodes that were added since with sixteen samples, a block per joint.
    pub fn compare(&self, samples: &[Lanes], nearest: &mut Nearest) {
        if nearest.compared < self.len() {
            self.nodes.compare(samples, nearest);
        }
    }

    /// Returns the parent of a node, unless it is a root.
    pub fn parent(&self, i: usize) -> Option<usize> {
        self.parents.get(i).filter(|parent| **parent != ROOT).map(|parent| *parent as usize)
    }

    /// Returns a node and those above it, up to its root.
    pub fn way_up(&self, node: usize) -> impl Iterator<Item = usize> {
        std::iter::successors(Some(node), |i| self.parent(*i))
    }
}

/// Sixteen samples, and the nodes of two trees nearest to each.
#[derive(Debug, Clone)]
pub struct Batch {
    /// For each joint its values in all samples.
    samples: Vec<Lanes>,
    nearest: [Nearest; 2],
    next: usize,
}

impl Batch {
    /// Creates one of which all samples are used.
    pub fn new(dof: usize) -> Self {
        Self { samples: vec![Lanes::splat(0.0); dof], nearest: [Nearest::NONE; 2], next: LANES }
    }

    /// Forgets which nodes of a tree are nearest to the samples.
    pub fn forget_nearest(&mut self, side: usize) {
        self.nearest[side] = Nearest::NONE;
    }

    /// Returns whether all samples are used.
    pub fn is_used(&self) -> bool {
        self.next >= LANES
    }

    /// Draws all samples: `draw` writes them, a block for each joint.
    pub fn fill(&mut self, draw: impl FnOnce(&mut [Lanes])) {
        draw(&mut self.samples);
        self.nearest = [Nearest::NONE; 2];
        self.next = 0;
    }

    /// Returns the lane of the next sample in the domain of the node of a tree that is nearest to it, and the number of
    /// samples that were used, at most `most`; `side` is the tree's number.
    pub fn next(&mut self, tree: &Tree, side: usize, most: u64) -> (Option<usize>, u64) {
        let nearest = &mut self.nearest[side];
        tree.compare(&self.samples, nearest);
        let first = self.next;
        let end = LANES.min(first + most.min(LANES as u64) as usize);
        let found = (first..end).find(|&lane| tree.is_in_domain(nearest, lane));
        self.next = found.map_or(end, |lane| lane + 1);
        (found, (self.next - first) as u64)
    }

    /// Returns the nodes of a tree nearest to the samples.
    pub fn nearest(&self, side: usize) -> &Nearest {
        &self.nearest[side]
    }

    /// Copies the sample of a lane to a lane of others.
    pub fn copy_to(&self, lane: usize, to: usize, samples: &mut [Lanes]) {
        samples.iter_mut().zip(&self.samples).for_each(|(to_block, block)| to_block.0[to] = block.0[lane]);
    }
}
