//! RRT-Connect (Kuffner and LaValle, 2000): two trees, from the start and from the goals, that grow towards random
//! configurations and towards each other. Nodes that fail to grow draw fewer samples (dynamic domain: Yershova,
//! Jaillet, Siméon and LaValle, 2005), and the smaller tree grows first. Every edge is checked, the joining one as well.
//!
//! Joints that turn without end are taken the short way round: a node follows its parent without a jump, and where the
//! trees meet, the goal's half of the path is turned to where the start's half has come to.

use crate::collision::checker::{CollisionChecker, Stop};

use super::nearest::Tree;
use super::path::{Path, between, distance, unwind, unwind_all};
use super::sampler::Sampler;

/// How the search goes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RrtSettings {
    /// Longest edge [rad].
    pub range: f64,
    /// Radius of a node's domain after its first failure [rad].
    pub radius: f64,
    /// By which part the radius shrinks with each further failure.
    pub shrink: f64,
    /// Smallest radius [rad].
    pub smallest: f64,
    /// Most samples.
    pub max_samples: u64,
    /// Most nodes in both trees.
    pub max_nodes: usize,
}

impl Default for RrtSettings {
    fn default() -> Self {
        Self { range: 1.0, radius: 4.0, shrink: 1e-4, smallest: 1.0, max_samples: 10_000_000, max_nodes: 1_000_000 }
    }
}

/// Why a search ended without a path.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ended {
    /// It was stopped: by its deadline or by somebody.
    Stopped,
    /// It took more samples or nodes than it may.
    Exhausted,
}

/// What a search did.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SearchCount {
    /// Samples drawn.
    pub samples: u64,
    /// Nodes in both trees.
    pub nodes: usize,
}

/// Searches a path from `start` to any of `goals`, all of them free. The same sampler gives the same path.
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
    let mut grow = Grow { checker, settings, turns: &turns, stop };
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
        // The smaller tree grows; equal ones take turns.
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

struct Grow<'a, C> {
    checker: &'a mut C,
    settings: &'a RrtSettings,
    turns: &'a [bool],
    stop: &'a Stop,
}

impl<C: CollisionChecker> Grow<'_, C> {
    /// Whether a node reaches a configuration; its domain shrinks if not.
    fn reaches(&mut self, tree: &mut Tree, node: usize, to: &[f64]) -> bool {
        let free = self.checker.motion_is_free(tree.node(node), to, self.stop);
        let radius = tree.radius(node);
        if free {
            if radius.is_finite() {
                tree.set_radius(node, radius * (1.0 + self.settings.shrink));
            }
        } else if radius.is_finite() {
            tree.set_radius(node, (radius * (1.0 - self.settings.shrink)).max(self.settings.smallest));
        } else {
            tree.set_radius(node, self.settings.radius);
        }
        free
    }

    /// Grows a tree in equal steps towards a configuration of the other, up to touching it: then the index of the node
    /// that stands there.
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
