//! Continuous collision checks. At the middle of a piece of the motion, each pair is checked with a margin: the most
//! that its members can approach each other on the way to either end of the piece (a bound from the joints' lever
//! arms). A pair farther apart than its margin is free on the whole piece; for the other pairs, the piece is split in
//! two. So most pairs need few checks, and a motion that passes is also free between the samples.
//!
//! All pieces of one size are checked before those of half the size, which finds contacts early.

use super::checker::Stop;
use super::exact::{ExactChecker, Gap};
use super::report::Pair;

/// A piece of a motion, and its unproven pairs.
#[derive(Debug, Clone, Copy)]
struct Piece {
    start: f64,
    first: u32,
    last: u32,
}

/// Buffers of a motion check.
#[derive(Debug, Clone)]
pub(super) struct Pieces {
    q: Vec<f64>,
    /// For each pair, the most that it can approach on the whole motion [m].
    reach: Vec<f64>,
    now: Vec<Piece>,
    next: Vec<Piece>,
    /// Pairs of the pieces.
    pairs_now: Vec<u32>,
    pairs_next: Vec<u32>,
    /// Maximum motion of each link [m].
    links: Vec<f64>,
}

impl Pieces {
    pub(super) fn new(dof: usize, pairs: usize) -> Self {
        let none = Vec::new;
        let (now, next) = (Vec::new(), Vec::new());
        Self {
            q: vec![0.0; dof],
            reach: vec![0.0; pairs],
            now,
            next,
            pairs_now: none(),
            pairs_next: none(),
            links: vec![],
        }
    }
}

impl ExactChecker {
    /// Returns whether nothing touches on a motion, as defined by `CollisionChecker::motion_is_free`.
    pub(super) fn check_motion(&mut self, from: &[f64], to: &[f64], stop: &Stop) -> bool {
        // After the deadline, every call returns at once.
        if stop.is_over() || self.always.is_some() || !self.is_clear(to) || !self.is_clear(from) {
            return false;
        }
        let mut pieces = std::mem::replace(&mut self.pieces, Pieces::new(0, 0));
        let free = self.check_motion_with(&mut pieces, from, to, stop);
        self.pieces = pieces;
        free
    }

    /// Returns whether nothing touches at a configuration.
    fn is_clear(&mut self, q: &[f64]) -> bool {
        use super::checker::CollisionChecker;
        self.is_free(q)
    }

    fn check_motion_with(&mut self, p: &mut Pieces, from: &[f64], to: &[f64], stop: &Stop) -> bool {
        let most = self.measure(p, from, to);
        p.now.clear();
        p.pairs_now.clear();
        p.pairs_now.extend(0..self.pairs.len() as u32);
        p.now.push(Piece { start: 0.0, first: 0, last: p.pairs_now.len() as u32 });
        let mut size = 1.0;
        while !p.now.is_empty() {
            // The last pieces are below the resolution.
            let last = most * size <= self.resolution.motion;
            p.next.clear();
            p.pairs_next.clear();
            for i in 0..p.now.len() {
                let piece = p.now[i];
                let middle = piece.start + 0.5 * size;
                for ((x, a), b) in p.q.iter_mut().zip(from).zip(to) {
                    *x = a + (b - a) * middle;
                }
                if stop.is_over() {
                    return false;
                }
                self.place(&p.q);
                if let Some(witness) = self.witness
                    && self.gap(witness, 0.0) == Gap::Touch
                {
                    return false;
                }
                let first = p.pairs_next.len() as u32;
                for k in piece.first..piece.last {
                    let pair = p.pairs_now[k as usize];
                    match self.gap(pair as usize, 0.5 * size * p.reach[pair as usize]) {
                        Gap::Far => {}
                        Gap::Close => p.pairs_next.push(pair),
                        Gap::Touch => {
                            self.witness = Some(pair as usize);
                            return false;
                        }
                    }
                }
                let end = p.pairs_next.len() as u32;
                if end > first && !last {
                    p.next.push(Piece { start: piece.start, first, last: end });
                    p.next.push(Piece { start: middle, first, last: end });
                }
            }
            std::mem::swap(&mut p.now, &mut p.next);
            std::mem::swap(&mut p.pairs_now, &mut p.pairs_next);
            size *= 0.5;
        }
        true
    }

    /// Computes how much each pair can approach on a motion; returns the maximum.
    fn measure(&self, p: &mut Pieces, from: &[f64], to: &[f64]) -> f64 {
        let reach = |levers: &[f64]| {
            levers.iter().zip(from.iter().zip(to)).map(|(lever, (a, b))| lever * (b - a).abs()).sum::<f64>()
        };
        p.links.clear();
        p.links.extend(self.scene.links.iter().map(|link| reach(&link.levers)));
        let mut most = 0.0;
        for ((to, pair), link_pair) in p.reach.iter_mut().zip(&self.pairs).zip(&self.link_pairs) {
            *to = match *pair {
                Pair::Obstacle(link, _) => p.links[link],
                Pair::Links(..) => reach(&self.scene.pairs[*link_pair].levers),
            };
            most = f64::max(most, *to);
        }
        most
    }
}
