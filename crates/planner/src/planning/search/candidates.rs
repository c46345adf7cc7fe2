//! The samples that a tree grows towards next, and the ends of the edges to them, checked together.
//!
//! Most edges of a search in a narrow place touch, and most of those touch at their end. Sixteen ends are checked in
//! about the time that three edges take, and the edges to those that touch are refused without a check of their own.

use dimos_kernels::block::{LANES, Lanes};
use dimos_kernels::nearest::Nearest;

use super::edges::EdgeValidator;
use super::nearest::{Batch, Tree};
use super::path::unwind;

/// Up to sixteen samples for one tree.
#[derive(Debug, Clone)]
pub struct Candidates {
    /// For each joint its values in all samples.
    samples: Vec<Lanes>,
    nearest: Nearest,
    number: usize,
    next: usize,
    /// Ends of the edges to the samples, a block per joint.
    ends: Vec<Lanes>,
    /// Nodes that these edges begin at.
    from: [usize; LANES],
    /// Lanes whose ends are known to touch.
    blocked: u16,
}

impl Candidates {
    /// Creates one without samples.
    pub fn new(dof: usize) -> Self {
        let none = vec![Lanes::splat(0.0); dof];
        Self {
            samples: none.clone(),
            nearest: Nearest::NONE,
            number: 0,
            next: 0,
            ends: none,
            from: [0; LANES],
            blocked: 0,
        }
    }

    /// Returns whether all samples are used.
    pub fn is_empty(&self) -> bool {
        self.next == self.number
    }

    /// Returns the number of samples, used ones included.
    pub fn len(&self) -> usize {
        self.number
    }

    /// Forgets which nodes of the tree are nearest to the samples.
    pub fn forget_nearest(&mut self) {
        self.nearest = Nearest::NONE;
    }

    /// Removes all samples.
    pub fn clear(&mut self) {
        (self.number, self.next, self.blocked) = (0, 0, 0);
    }

    /// Adds the sample of a lane of a batch.
    pub fn add(&mut self, batch: &Batch, lane: usize, side: usize) {
        let to = self.number;
        batch.copy_to(lane, to, &mut self.samples);
        self.nearest.copy_lane(to, batch.nearest(side), lane);
        self.number += 1;
    }

    /// Returns the lane of the next sample, the node of the tree nearest to it, and their distance [rad]; `None` if it
    /// is no longer in that node's domain.
    pub fn next(&mut self, tree: &Tree) -> Option<(usize, usize, f64)> {
        let lane = self.next;
        self.next += 1;
        tree.compare(&self.samples, &mut self.nearest);
        let edge = (lane, self.nearest.node(lane), self.nearest.distance(lane));
        tree.is_in_domain(&self.nearest, lane).then_some(edge)
    }

    /// Copies the sample of a lane.
    pub fn sample(&self, lane: usize, q: &mut [f64]) {
        q.iter_mut().zip(&self.samples).for_each(|(q, block)| *q = f64::from(block.0[lane]));
    }

    /// Checks the ends of the edges to all samples, from the nodes nearest to them, if they are at least `min_batch`;
    /// `way`: see [`aim`]. `at` is scratch space for a configuration.
    pub fn check_ends(
        &mut self,
        tree: &Tree,
        way: (&[bool], f64),
        min_batch: usize,
        at: &mut [f64],
        check: &mut dyn EdgeValidator,
    ) {
        if self.number < min_batch {
            return;
        }
        for lane in 0..LANES {
            // The lanes without a sample repeat one that has one.
            let sample = lane % self.number;
            let node = self.nearest.node(sample);
            self.from[lane] = node;
            self.sample(sample, at);
            aim(tree.node(node), self.nearest.distance(sample), way, at);
            self.ends.iter_mut().zip(&*at).for_each(|(block, q)| block.0[lane] = *q as f32);
        }
        self.blocked = check.blocked(&self.ends, u16::MAX >> (LANES - self.number));
    }

    /// Returns whether the edge from a node to the sample of a lane is known to touch.
    pub fn is_blocked(&self, lane: usize, node: usize) -> bool {
        self.blocked >> lane & 1 == 1 && self.from[lane] == node
    }
}

/// Moves `at`, a sample, to the end of the edge towards it from a node at a distance of `far`: no farther than `range`
/// [rad], and the short way round for the joints marked by `turns`.
pub fn aim(node: &[f64], far: f64, (turns, range): (&[bool], f64), at: &mut [f64]) {
    unwind(at, node, turns);
    let part = (range / far).min(1.0);
    at.iter_mut().zip(node).for_each(|(q, from)| *q = from + (*q - from) * part);
}
