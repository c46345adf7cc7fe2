//! Motions between two configurations: by samples, and with proof.
//!
//! Samples say whether a motion is free at a stated step. A proof says that nothing touches anywhere between them:
//! at the middle of a piece, everything keeps more distance than anything can move on the way to the piece's ends
//! (a bound from the joints' lever arms); a piece where it does not is cut in two.

use crate::collision::checker::{CollisionChecker, Stop, Verdict};

use super::path::{between, distance};

/// Checks motions; keeps its buffers.
#[derive(Debug, Clone, Default)]
pub struct Edges {
    q: Vec<f64>,
    margin: Vec<f64>,
    motion: Vec<f64>,
    /// Whether [`Edges::is_good`] asks for proof.
    pub prove: bool,
    /// Configurations that were looked at.
    pub looks: u64,
}

impl Edges {
    /// Buffers for configurations of `dof` joints.
    pub fn new(dof: usize) -> Self {
        Self { q: vec![0.0; dof], margin: vec![0.0; dof], motion: vec![0.0; dof], prove: false, looks: 0 }
    }

    /// Whether the motion is free at every step of the checker's resolution, its end included, its start not. The
    /// order is coarse to fine, so that most blocked motions are found by the first few. `false` when it was stopped.
    pub fn is_free<C: CollisionChecker>(&mut self, checker: &mut C, from: &[f64], to: &[f64], stop: &Stop) -> bool {
        let steps = (distance(from, to) / checker.resolution().step).ceil().max(1.0) as usize;
        let mut see = |edges: &mut Self, k: usize| {
            between(from, to, k as f64 / steps as f64, &mut edges.q);
            edges.looks += 1;
            !stop.is_over() && checker.is_free(&edges.q)
        };
        if !see(self, steps) {
            return false;
        }
        // Odd multiples of ever smaller powers of two reach every step once.
        let mut stride = steps.next_power_of_two() / 2;
        while stride > 0 {
            let mut k = stride;
            while k < steps {
                if !see(self, k) {
                    return false;
                }
                k += 2 * stride;
            }
            stride /= 2;
        }
        true
    }

    /// Whether it is proven that nothing touches anywhere between two configurations, up to the checker's stated
    /// motion. `false` when something touches, or when it was stopped.
    pub fn is_proven<C: CollisionChecker>(&mut self, checker: &mut C, from: &[f64], to: &[f64], stop: &Stop) -> bool {
        for ((m, a), b) in self.motion.iter_mut().zip(from).zip(to) {
            *m = (b - a).abs();
        }
        let reach = checker.reach(&self.motion);
        // Pieces of some centimetres: smaller ones would be looked at in vain where there is room.
        let pieces = (reach / 0.08).ceil().max(1.0) as usize;
        let depth = (reach / pieces as f64 / checker.resolution().proof.max(1e-9)).log2().ceil().max(0.0) as u32;
        (0..pieces).all(|k| {
            let (a, b) = (k as f64 / pieces as f64, (k + 1) as f64 / pieces as f64);
            self.prove(checker, (from, to), a, b, depth, stop)
        })
    }

    /// Whether the motion is free by samples, and with proof where these edges want it.
    pub fn is_good<C: CollisionChecker>(&mut self, checker: &mut C, from: &[f64], to: &[f64], stop: &Stop) -> bool {
        self.is_free(checker, from, to, stop) && (!self.prove || self.is_proven(checker, from, to, stop))
    }

    fn prove<C: CollisionChecker>(
        &mut self,
        checker: &mut C,
        ends: (&[f64], &[f64]),
        a: f64,
        b: f64,
        depth: u32,
        stop: &Stop,
    ) -> bool {
        between(ends.0, ends.1, (a + b) * 0.5, &mut self.q);
        for ((margin, x), y) in self.margin.iter_mut().zip(ends.0).zip(ends.1) {
            *margin = (y - x).abs() * (b - a) * 0.5;
        }
        self.looks += 1;
        if stop.is_over() {
            return false;
        }
        let margin = (depth > 0).then_some(self.margin.as_slice());
        match checker.look(&self.q, margin) {
            Verdict::Free => true,
            Verdict::Hit(_) => false,
            Verdict::Close => {
                let middle = (a + b) * 0.5;
                self.prove(checker, ends, a, middle, depth - 1, stop)
                    && self.prove(checker, ends, middle, b, depth - 1, stop)
            }
        }
    }
}
