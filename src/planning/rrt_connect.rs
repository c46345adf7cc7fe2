//! RRT-Connect (Kuffner and LaValle, 2000): two trees, one from the start and one from the goals, grow towards random
//! configurations and towards each other. Nodes that fail to grow attract fewer samples (dynamic domain: Yershova,
//! Jaillet, Siméon and LaValle, 2005), and the smaller tree grows first. Every edge is checked, including the joining
//! one.
//!
//! Continuous joints move the short way round: a node follows its parent without a jump, and where the trees meet, the
//! goal's half of the path is shifted by whole turns to match the start's half.

use crate::collision::checker::{CollisionChecker, Stop};

use super::nearest::Tree;
use super::path::{Path, between, distance, unwind, unwind_all};
use super::sampler::Sampler;

/// Settings of the search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RrtSettings {
    /// Maximum edge length [rad].
    pub range: f64,
    /// Radius of a node's domain after its first failure [rad].
    pub radius: f64,
    /// α: relative growth of the radius with each success, and reduction with each further failure.
    pub alpha: f64,
    /// Minimum radius [rad].
    pub min_radius: f64,
    /// Maximum number of samples.
    pub max_samples: u64,
    /// Maximum number of nodes in both trees.
    pub max_nodes: usize,
}

impl Default for RrtSettings {
    fn default() -> Self {
        Self { range: 1.0, radius: 4.0, alpha: 1e-4, min_radius: 1.0, max_samples: 10_000_000, max_nodes: 1_000_000 }
    }
}

/// Why a search ended without a path.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ended {
    /// Stopped by its deadline or a cancel.
    Stopped,
    /// Reached its maximum number of samples or nodes.
    Exhausted,
}

/// Statistics of a search.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SearchCount {
    /// Samples drawn.
    pub samples: u64,
    /// Nodes in both trees.
    pub nodes: usize,
}

/// Searches a path from `start` to any of `goals`; all of them must be free. The same sampler gives the same path.
pub fn search<C: CollisionChecker>(
    checker: &mut C,
    start: &[f64],
    goals: &[Vec<f64>],
    settings: &RrtSettings,
    sampler: &mut Sampler,
    stop: &Stop,
) -> (Result<Path, Ended>, SearchCount) {
    let dof = start.len();
    let turns = checker.turns().to_vec();
    let mut trees = [Tree::new(&turns), Tree::new(&turns)];
    trees[0].add(start, None);
    for goal in goals {
        trees[1].add(goal, None);
    }
    let mut grow = TreeGrower { checker, settings, turns: &turns, stop };
    let mut count = SearchCount::default();
    let mut sample = vec![0.0; dof];
    let mut at = vec![0.0; dof];
    let mut side = 0;
    loop {
        count.nodes = trees[0].len() + trees[1].len();
        if stop.is_over() {
            return (Err(Ended::Stopped), count);
        }
        if count.samples >= settings.max_samples || count.nodes >= settings.max_nodes {
            return (Err(Ended::Exhausted), count);
        }
        // The smaller tree grows; trees of equal size alternate.
        side = match trees[side].len().cmp(&trees[1 - side].len()) {
            std::cmp::Ordering::Less => side,
            _ => 1 - side,
        };
        sampler.next(&mut sample);
        count.samples += 1;
        let (nearest, far) = trees[side].nearest(&sample);
        if far > trees[side].radius(nearest) || far < 1e-9 {
            continue;
        }
        unwind(&mut sample, trees[side].node(nearest), &turns);
        between(trees[side].node(nearest), &sample, (settings.range / far).min(1.0), &mut at);
        if !grow.reaches(&mut trees[side], nearest, &at) {
            continue;
        }
        let added = trees[side].add(&at, Some(nearest));
        let [first, second] = &mut trees;
        let (own, other) = if side == 0 { (first, second) } else { (second, first) };
        if let Some(joined) = grow.join(other, own.node(added)) {
            let (from_start, from_goal) = if side == 0 { (added, joined) } else { (joined, added) };
            let mut path: Path = trees[0].way_up(from_start).map(<[f64]>::to_vec).collect();
            path.reverse();
            let mut rest: Path = trees[1].way_up(from_goal).map(<[f64]>::to_vec).collect();
            unwind_all(&mut rest, trees[0].node(from_start), &turns);
            path.append(&mut rest);
            return (Ok(super::path::tidy(&path)), count);
        }
    }
}

struct TreeGrower<'a, C> {
    checker: &'a mut C,
    settings: &'a RrtSettings,
    turns: &'a [bool],
    stop: &'a Stop,
}

impl<C: CollisionChecker> TreeGrower<'_, C> {
    /// Tries to connect a node to a configuration; shrinks the node's domain on failure.
    fn reaches(&mut self, tree: &mut Tree, node: usize, to: &[f64]) -> bool {
        let free = self.checker.motion_is_free(tree.node(node), to, self.stop);
        let radius = tree.radius(node);
        if free {
            if radius.is_finite() {
                tree.set_radius(node, radius * (1.0 + self.settings.alpha));
            }
        } else if radius.is_finite() {
            tree.set_radius(node, (radius * (1.0 - self.settings.alpha)).max(self.settings.min_radius));
        } else {
            tree.set_radius(node, self.settings.radius);
        }
        free
    }

    /// Grows a tree in equal steps towards a configuration of the other tree. Returns the index of the connecting node.
    fn join(&mut self, tree: &mut Tree, to: &[f64]) -> Option<usize> {
        let (mut node, far) = tree.nearest(to);
        if far < 1e-9 {
            return Some(node);
        }
        let steps = (far / self.settings.range).ceil().max(1.0) as usize;
        let from = tree.node(node).to_vec();
        let mut to = to.to_vec();
        unwind(&mut to, &from, self.turns);
        let mut at = vec![0.0; to.len()];
        for k in 1..=steps {
            between(&from, &to, k as f64 / steps as f64, &mut at);
            if k == steps {
                at.copy_from_slice(&to);
            }
            if !self.checker.motion_is_free(tree.node(node), &at, self.stop) {
                return None;
            }
            node = tree.add(&at, Some(node));
        }
        debug_assert!(distance(tree.node(node), &to) < 1e-9);
        Some(node)
    }
}
