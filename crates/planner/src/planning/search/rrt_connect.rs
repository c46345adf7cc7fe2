//! RRT-Connect (Kuffner and LaValle, 2000): two trees, one from the start and one from the goals, grow towards random
//! configurations and towards each other. Nodes that fail to grow attract fewer samples (dynamic domain: Yershova,
//! Jaillet, Siméon and LaValle, 2005), and the smaller tree grows first. Every edge is sampled, including the joining
//! one; what takes long is checked once an edge is part of a path, and what grew from one that touches is removed (lazy
//! checks: Sánchez and Latombe, "A single-query bi-directional probabilistic roadmap planner with lazy collision
//! checking", 2001). Half of the samples are drawn in the domains of random nodes: of the others, hardly any is in one.
//!
//! Continuous joints move the short way round: a node follows its parent without a jump, and where the trees meet, the
//! goal's half of the path is shifted by whole turns to match the start's half.

use dimos_kernels::block::LANES;

use crate::collision::checker::Stop;
use dimos_robot::model::Limits;

use super::candidates::{Candidates, aim};
use super::edges::EdgeValidator;
use super::nearest::{Batch, Tree};
use super::path::{Path, between, distance, tidy, unwind, unwind_all};
use super::sampler::Sampler;
use super::settings::RrtSettings;

/// Statistics of a search.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SearchCount {
    /// Samples drawn.
    pub samples: u64,
    /// Nodes in both trees.
    pub nodes: usize,
}

/// How far a search goes before it pauses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Quantum {
    /// Edges checked, or [samples](RrtSettings::samples_per_edge) for each.
    pub edges: u64,
    /// Samples drawn.
    pub samples: u64,
    /// Nodes added.
    pub nodes: usize,
}

/// The stop condition is tested once per this number of samples, and of edges that are checked: a clock takes as long
/// as a short edge.
const POLL: u64 = 1024;
const POLL_CHECKS: u64 = 8;

/// A search with one maximum edge length. It can be paused and continued, and the same sampler gives the same path.
#[derive(Debug, Clone)]
pub struct Search {
    settings: RrtSettings,
    range: f64,
    /// The length that a path must be shorter than [rad].
    most: f64,
    limits: Vec<Limits>,
    turns: Vec<bool>,
    sampler: Sampler,
    trees: [Tree; 2],
    /// Number of goals: the first nodes of their tree.
    goals: usize,
    side: usize,
    batch: Batch,
    /// Edges in a row that were not free.
    failures: u64,
    /// Samples for each tree.
    candidates: [Candidates; 2],
    count: SearchCount,
    sample: Vec<f64>,
    at: Vec<f64>,
    /// The node of each tree where they met.
    met: Option<[usize; 2]>,
    /// Both ends of the way on which the other tree grows.
    ends: [Vec<f64>; 2],
}

impl Search {
    /// Prepares a search from `start` to any of `goals`; all of them must be free.
    pub fn new(
        start: &[f64],
        goals: &[Vec<f64>],
        (limits, turns): (&[Limits], &[bool]),
        settings: &RrtSettings,
        range: f64,
        seed: u64,
    ) -> Self {
        let dof = start.len();
        let mut trees = [Tree::new(turns), Tree::new(turns)];
        trees[0].add(start, None);
        for goal in goals {
            trees[1].add(goal, None);
        }
        Self {
            settings: *settings,
            range,
            most: f64::INFINITY,
            limits: limits.to_vec(),
            turns: turns.to_vec(),
            sampler: Sampler::new(limits, start, seed),
            count: SearchCount { samples: 0, nodes: trees[0].len() + trees[1].len() },
            trees,
            goals: goals.len(),
            side: 0,
            batch: Batch::new(dof),
            failures: 0,
            met: None,
            candidates: [Candidates::new(dof), Candidates::new(dof)],
            sample: vec![0.0; dof],
            at: vec![0.0; dof],
            ends: [vec![0.0; dof], vec![0.0; dof]],
        }
    }

    /// Looks for paths that are shorter than `most` [rad] only. Does nothing for robots with continuous joints, whose
    /// way round is not known.
    pub fn shorter_than(mut self, most: f64) -> Self {
        if !self.turns.contains(&true) {
            self.most = most;
        }
        self
    }

    /// Returns whether a path that passes a configuration may be short enough.
    fn may_be_short(&self, q: &[f64]) -> bool {
        if self.most.is_infinite() {
            return true;
        }
        // The roots: the start, and the goals.
        let from = distance(self.trees[0].node(0), q);
        (0..self.goals).any(|goal| from + distance(q, self.trees[1].node(goal)) < self.most)
    }

    /// Returns the statistics so far.
    pub fn count(&self) -> SearchCount {
        self.count
    }

    /// Continues for a quantum; returns the path once it is found. After that, begins with the same path: the check may
    /// be another one now.
    pub fn run(&mut self, check: &mut dyn EdgeValidator, quantum: Quantum, stop: &Stop) -> Option<Path> {
        let end = (self.count.samples + quantum.samples, self.count.nodes + quantum.nodes);
        let (began, mut polled) = (self.count.samples, None);
        // Edges that were tried, and those of them that needed a check of their own.
        let (mut edges, mut checked, mut polled_checks) = (0, 0, 0);
        let known = self.met.and_then(|_| self.joined(check));
        if known.is_some() {
            return known;
        }
        loop {
            let samples = self.count.samples;
            let cost = edges + (samples - began) / self.settings.samples_per_edge;
            if cost >= quantum.edges || samples >= end.0 || self.count.nodes >= end.1 {
                return None;
            }
            if polled.is_none_or(|polled| samples >= polled + POLL) || checked >= polled_checks + POLL_CHECKS {
                (polled, polled_checks) = (Some(samples), checked);
                if stop.is_over() {
                    return None;
                }
            }
            // The smaller tree grows; trees of equal size alternate.
            if self.trees[self.side].len() >= self.trees[1 - self.side].len() {
                self.side = 1 - self.side;
            }
            let side = self.side;
            if self.candidates[side].is_empty() {
                self.fill(end.0, check);
                if self.candidates[side].is_empty() {
                    continue;
                }
            }
            let tree = &self.trees[side];
            let Some((lane, nearest, far)) = self.candidates[side].next(tree) else { continue };
            if self.candidates[side].is_blocked(lane, nearest) {
                edges += 1;
                self.failures += 1;
                self.adapt(nearest, false);
                continue;
            }
            self.candidates[side].sample(lane, &mut self.at);
            aim(tree.node(nearest), far, (&self.turns, self.range), &mut self.at);
            // Samples are drawn in single precision.
            self.at.iter_mut().zip(&self.limits).for_each(|(q, l)| *q = q.max(l.lower).min(l.upper));
            if !self.may_be_short(&self.at) {
                continue;
            }
            (edges, checked) = (edges + 1, checked + 1);
            let free = check.is_free(self.trees[side].node(nearest), &self.at);
            self.adapt(nearest, free);
            if !free {
                self.failures += 1;
                continue;
            }
            self.failures = 0;
            let found = self.extend(nearest, check, &mut edges);
            self.count.nodes = self.trees[0].len() + self.trees[1].len();
            if found.is_some() {
                return found;
            }
        }
    }

    /// Draws samples for the tree that grows, up to a number of all samples: one that is in a domain, or sixteen where
    /// edges fail, whose ends are then checked together.
    fn fill(&mut self, end: u64, check: &mut dyn EdgeValidator) {
        let together = self.failures >= self.settings.batch_after;
        let most = if together { LANES } else { 1 };
        self.candidates[self.side].clear();
        for _ in 0..self.settings.max_draws {
            if self.candidates[self.side].len() == most || self.count.samples >= end {
                break;
            }
            if self.batch.is_used() {
                self.draw();
            }
            let left = end - self.count.samples;
            let (lane, used) = self.batch.next(&self.trees[self.side], self.side, left);
            self.count.samples += used;
            if let Some(lane) = lane {
                self.candidates[self.side].add(&self.batch, lane, self.side);
            }
        }
        if together {
            let Self { candidates, trees, turns, range, side, at, settings, .. } = self;
            candidates[*side].check_ends(&trees[*side], (turns, *range), settings.min_batch, at, check);
        }
    }

    /// Adapts the domain of a node to whether an edge from it was free.
    fn adapt(&mut self, node: usize, free: bool) {
        let (settings, tree) = (&self.settings, &mut self.trees[self.side]);
        let radius = tree.radius(node);
        let radius = match (free, radius.is_finite()) {
            (true, _) => radius * (1.0 + settings.alpha),
            (false, true) => (radius * (1.0 - settings.alpha)).max(settings.min_radius),
            (false, false) => settings.radius,
        };
        tree.set_radius(node, radius);
    }

    /// Draws the next samples.
    fn draw(&mut self) {
        let Self { sampler, limits, settings, trees, batch, count, .. } = self;
        let tree = &trees[self.side];
        batch.fill(|samples| {
            sampler.fill(samples);
            if count.samples < settings.uniform_samples {
                return;
            }
            for lane in (1..LANES).step_by(2) {
                let node = sampler.below(tree.len());
                let radius = Some(tree.radius(node)).filter(|r| r.is_finite()).unwrap_or(settings.radius);
                sampler.fill_from_ball((tree.node(node), radius), limits, lane, samples);
            }
        });
    }

    /// Adds the current configuration, the end of a free edge, to the tree that grows, and grows the other one towards
    /// it; returns the path if they meet.
    fn extend(&mut self, nearest: usize, check: &mut dyn EdgeValidator, edges: &mut u64) -> Option<Path> {
        let [first, second] = &mut self.trees;
        let (own, other) = if self.side == 0 { (first, second) } else { (second, first) };
        let added = own.add(&self.at, Some(nearest));
        // The other tree grows in equal steps towards the new node.
        let (mut node, far) = other.nearest(&self.at);
        let [from, to] = &mut self.ends;
        from.copy_from_slice(other.node(node));
        to.copy_from_slice(&self.at);
        unwind(to, from, &self.turns);
        let steps = (far / self.range).ceil().max(1.0) as usize;
        for k in 1..=steps {
            between(from, to, k as f64 / steps as f64, &mut self.sample);
            if k == steps {
                self.sample.copy_from_slice(to);
            }
            *edges += 1;
            if !check.is_free(other.node(node), &self.sample) {
                return None;
            }
            node = other.add(&self.sample, Some(node));
        }
        self.met = Some(if self.side == 0 { [added, node] } else { [node, added] });
        self.joined(check)
    }

    /// Returns the path through the nodes where the trees met, unless an edge of it is not confirmed.
    fn joined(&mut self, check: &mut dyn EdgeValidator) -> Option<Path> {
        let [from_start, from_goal] = self.met?;
        if !(self.confirm(0, from_start, check) && self.confirm(1, from_goal, check)) {
            self.met = None;
            return None;
        }
        let mut path = Path::with_capacity(2 * LANES);
        path.extend(self.trees[0].way_up(from_start).map(|i| self.trees[0].node(i).to_vec()));
        path.reverse();
        let met = path.len();
        path.extend(self.trees[1].way_up(from_goal).map(|i| self.trees[1].node(i).to_vec()));
        unwind_all(&mut path[met..], self.trees[0].node(from_start), &self.turns);
        Some(tidy(path))
    }

    /// Returns whether all edges from a node up to its root are confirmed; otherwise removes what grew from one that is
    /// not.
    fn confirm(&mut self, side: usize, node: usize, check: &mut dyn EdgeValidator) -> bool {
        let tree = &self.trees[side];
        let mut is_refused = |i: &usize| {
            let parent = tree.parent(*i);
            parent.is_some_and(|parent| !check.is_confirmed(tree.node(parent), tree.node(*i)))
        };
        let refused = tree.way_up(node).find(&mut is_refused);
        let Some(refused) = refused else { return true };
        self.trees[side].remove(refused);
        self.batch.forget_nearest(side);
        self.candidates[side].forget_nearest();
        false
    }
}
