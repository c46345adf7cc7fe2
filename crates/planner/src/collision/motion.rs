//! Continuous collision checks. At the middle of a piece of the motion, each pair is checked with a margin: the most
//! that its members can approach each other on the way to either end of the piece (a bound from the joints' lever
//! arms). A pair farther apart than its margin is free on the whole piece; for the other pairs, the piece is split. So
//! most pairs need few checks, and a motion that passes is also free between the samples.
//!
//! First, covers are swept from sample to sample: balls at two samples that are somewhat larger contain all that is in
//! between, so that most motions that look free are proven to be with no more samples. A half that is not is swept
//! again, with twice as many.
//!
//! The rest is checked in pieces, sixteen at a time with covers, down to pieces on which nothing moves far, and
//! then exactly, split in two each time. All pieces of one size are checked before smaller ones, which finds contacts
//! early.

use dimos_kernels::block::LANES;
use dimos_kernels::discrete::Proof;

use super::checker::{Samples, Stop};
use super::exact::{ExactChecker, Gap};
use super::report::Pair;
use super::settings::CertificationSettings;

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
    /// Both ends of a part of a motion.
    ends: [Vec<f64>; 2],
    /// The motion that was measured, from its first configuration to its last.
    measured: [Vec<f64>; 2],
    /// For each pair, the most that it can approach on it [m].
    reach: Vec<f64>,
    now: Vec<Piece>,
    next: Vec<Piece>,
    /// Pairs of the pieces.
    pairs_now: Vec<u32>,
    pairs_next: Vec<u32>,
    /// Pairs of the pieces that are checked together.
    together: Vec<u32>,
    /// Maximum motion of each link [m].
    links: Vec<f64>,
}

impl Pieces {
    pub(super) fn new(dof: usize, pairs: usize) -> Self {
        let none = Vec::new;
        Self {
            q: vec![0.0; dof],
            ends: [vec![0.0; dof], vec![0.0; dof]],
            measured: [vec![], vec![]],
            reach: vec![0.0; pairs],
            now: Vec::new(),
            next: Vec::new(),
            pairs_now: none(),
            pairs_next: none(),
            together: none(),
            links: vec![],
        }
    }

    /// Sets `q` to a place on a motion.
    fn place(&mut self, from: &[f64], to: &[f64], at: f64) {
        place((from, to), at, &mut self.q);
    }

    /// Splits all pieces into parts of a size; they keep their pairs.
    fn split(&mut self, parts: usize, size: f64) {
        for piece in &self.now {
            self.next.extend((0..parts).map(|i| Piece { start: piece.start + i as f64 * size, ..*piece }));
        }
        std::mem::swap(&mut self.now, &mut self.next);
        self.next.clear();
    }

    /// Removes all pieces, also those that a check left when it ended early.
    fn clear(&mut self) {
        self.now.clear();
        self.next.clear();
        self.pairs_now.clear();
        self.pairs_next.clear();
    }

    /// Makes the pieces found the ones to check.
    fn advance(&mut self) {
        std::mem::swap(&mut self.now, &mut self.next);
        std::mem::swap(&mut self.pairs_now, &mut self.pairs_next);
        self.next.clear();
        self.pairs_next.clear();
    }
}

/// Prior knowledge of a motion, and depth of its check.
#[derive(Debug, Clone, Copy)]
struct Effort {
    /// It looks free.
    looks_free: bool,
    /// Parts that covers do not prove are checked in pieces.
    in_pieces: bool,
}

impl ExactChecker {
    /// Returns whether nothing touches on a motion, as defined by `CollisionChecker::motion_is_free`.
    pub(super) fn check_motion(&mut self, from: &[f64], to: &[f64], stop: &Stop) -> bool {
        self.prove((from, to), Effort { looks_free: false, in_pieces: true }, stop)
    }

    /// Same; gives up after this number of exact checks of configurations. `looks_free`: whether it is known to.
    pub(super) fn is_free_within(
        &mut self,
        exact_checks: u64,
        (from, to): (&[f64], &[f64]),
        looks_free: bool,
        stop: &Stop,
    ) -> bool {
        self.exact_checks_left = exact_checks;
        let free = self.prove((from, to), Effort { looks_free, in_pieces: true }, stop);
        self.exact_checks_left = u64::MAX;
        free
    }

    /// Returns whether covers alone prove that nothing touches on a motion: quick.
    pub(super) fn is_free_by_covers(&mut self, from: &[f64], to: &[f64], stop: &Stop) -> bool {
        self.prove((from, to), Effort { looks_free: false, in_pieces: false }, stop)
    }

    fn prove(&mut self, (from, to): (&[f64], &[f64]), effort: Effort, stop: &Stop) -> bool {
        // After the deadline, every call returns at once.
        if stop.is_over() || !from.iter().chain(to).all(|x| x.is_finite()) {
            return false;
        }
        let mut pieces = std::mem::replace(&mut self.pieces, Pieces::new(0, 0));
        self.measure(&mut pieces, from, to);
        let free = self.sweep(&mut pieces, (from, to), (0.0, 0), effort, stop);
        self.pieces = pieces;
        free
    }

    /// Proves the part of a motion that begins at a place and is left after this number of halvings, by sweeping
    /// covers; where that fails, both halves of it. Parts in contact, and short parts, are checked in pieces.
    fn sweep(
        &mut self,
        p: &mut Pieces,
        motion: (&[f64], &[f64]),
        (at, halved): (f64, i32),
        effort: Effort,
        stop: &Stop,
    ) -> bool {
        let (parts, part) = (f64::from(halved).exp2(), f64::from(-halved).exp2());
        let mut ends = std::mem::take(&mut p.ends);
        place(motion, at, &mut ends[0]);
        place(motion, at + part, &mut ends[1]);
        let (from, to, pads) = (&ends[0][..], &ends[1][..], (&self.pads[..], self.most_pad));
        let proof = Proof::Motion { reach: &p.reach, part, turn: self.lanes.turn(from, to) };
        let (left, samples) = self.lanes.touching(Samples::All, (from, to), pads, self.witness, proof, parts);
        self.checks += samples;
        self.witness = left.or(self.witness);
        // Halves of a motion that looks free do so, too.
        let looks = left.is_some() && halved == 0 && !effort.looks_free;
        let touches =
            looks && self.lanes.touching(Samples::All, (from, to), pads, self.witness, Proof::None, parts).0.is_some();
        p.ends = ends;
        if left.is_none() {
            return true;
        }
        if halved == self.settings.certification.sweep_halvings || touches {
            return effort.in_pieces && self.check_in_pieces(p, motion, (at, part), stop);
        }
        !stop.is_over()
            && self.sweep(p, motion, (at, halved + 1), effort, stop)
            && self.sweep(p, motion, (at + 0.5 * part, halved + 1), effort, stop)
    }

    /// Checks a part of a motion, from a place on, in pieces.
    fn check_in_pieces(
        &mut self,
        p: &mut Pieces,
        (from, to): (&[f64], &[f64]),
        (at, part): (f64, f64),
        stop: &Stop,
    ) -> bool {
        let CertificationSettings { parts, cover_size, max_unproven, .. } = self.settings.certification;
        let most = p.reach.iter().copied().fold(0.0, f64::max);
        let mut size = part / LANES as f64;
        p.clear();
        p.now.extend((0..LANES).map(|i| Piece { start: at + i as f64 * size, first: 0, last: 0 }));
        loop {
            let checked = p.now.len();
            if let Some(pair) = self.check_in_lanes(p, from, to, size) {
                self.witness = Some(pair);
                return false;
            }
            p.advance();
            if p.now.is_empty() {
                return true;
            }
            if stop.is_over() {
                return false;
            }
            if p.now.len() > max_unproven && 2 * p.now.len() > checked {
                // Covers prove little: contacts too shallow for them are found before the pieces are many.
                if !self.check_middles(p, from, to, size, stop) {
                    return false;
                }
                p.advance();
                if p.now.is_empty() {
                    return true;
                }
            } else if self.any_touches(p, from, to, size) {
                return false;
            }
            if most * size <= cover_size {
                break;
            }
            size /= parts as f64;
            p.split(parts, size);
        }
        let (first, last) =
            (p.now.first().map_or(at, |piece| piece.start), p.now.last().map_or(at + part, |p| p.start + size));
        // The rest may touch at the ends of the motion, where no other piece is.
        (last < 1.0 || self.first_touch(to).is_none())
            && (first > 0.0 || self.first_touch(from).is_none())
            && self.check_exactly(p, from, to, size, most, stop)
    }

    /// Finds the pieces, and their pairs, that are not proven free with covers; ends and returns the pair if one surely
    /// touches. Without pairs, a piece has all.
    fn check_in_lanes(&mut self, p: &mut Pieces, from: &[f64], to: &[f64], size: f64) -> Option<usize> {
        for at in (0..p.now.len()).step_by(LANES) {
            let number = (p.now.len() - at).min(LANES);
            p.together.clear();
            for lane in 0..number {
                let piece = p.now[at + lane];
                p.place(from, to, piece.start + 0.5 * size);
                for (values, q) in self.lanes.q.iter_mut().zip(&p.q) {
                    values.0[lane] = *q as f32;
                }
                // Parts of one piece follow each other.
                if lane == 0 || p.now[at + lane - 1].first != piece.first {
                    p.together.extend_from_slice(&p.pairs_now[piece.first as usize..piece.last as usize]);
                }
            }
            p.together.sort_unstable();
            p.together.dedup();
            let all = self.lanes.all.clone();
            let pairs = if p.together.is_empty() { &*all } else { &p.together[..] };
            self.checks += number as u64;
            let touching = self.lanes.find((number, 0.5 * size), &p.reach, &self.pads, pairs, self.witness);
            if touching.is_some() {
                return touching;
            }
            for lane in 0..number {
                let first = p.pairs_next.len() as u32;
                let close = self.lanes.close.iter().filter(|(_, lanes)| lanes >> lane & 1 == 1);
                p.pairs_next.extend(close.map(|(pair, _)| *pair));
                let last = p.pairs_next.len() as u32;
                if last > first {
                    p.next.push(Piece { start: p.now[at + lane].start, first, last });
                }
            }
        }
        None
    }

    /// Returns whether anything touches in the middle of the pieces that have most pairs: shallow contacts, which
    /// covers cannot find, are found before the pieces are many.
    fn any_touches(&mut self, p: &mut Pieces, from: &[f64], to: &[f64], size: f64) -> bool {
        let mut below = u32::MAX;
        for _ in 0..self.settings.certification.probes {
            let number = |piece: &&Piece| piece.last - piece.first;
            let Some(worst) = p.now.iter().filter(|piece| number(piece) < below).max_by_key(number).copied() else {
                break;
            };
            below = worst.last - worst.first;
            p.place(from, to, worst.start + 0.5 * size);
            self.place(&p.q);
            for k in worst.first..worst.last {
                let pair = p.pairs_now[k as usize] as usize;
                if self.gap_once(pair, 0.0) == Gap::Touch {
                    self.witness = Some(pair);
                    return true;
                }
            }
        }
        false
    }

    fn check_exactly(&mut self, p: &mut Pieces, from: &[f64], to: &[f64], whole: f64, most: f64, stop: &Stop) -> bool {
        let mut size = whole;
        while !p.now.is_empty() {
            if !self.check_middles(p, from, to, size, stop) {
                return false;
            }
            // The last pieces are below the resolution.
            if most * size <= self.resolution {
                return true;
            }
            p.advance();
            size *= 0.5;
            p.split(2, size);
        }
        true
    }

    /// Finds the pieces, and their pairs, that are not proven free by an exact check of the middle; returns false at a
    /// contact, and at the deadline.
    fn check_middles(&mut self, p: &mut Pieces, from: &[f64], to: &[f64], size: f64, stop: &Stop) -> bool {
        for i in 0..p.now.len() {
            let piece = p.now[i];
            if stop.is_over() || self.exact_checks_left == 0 {
                return false;
            }
            self.exact_checks_left -= 1;
            p.place(from, to, piece.start + 0.5 * size);
            self.place(&p.q);
            let first = p.pairs_next.len() as u32;
            for k in piece.first..piece.last {
                let pair = p.pairs_now[k as usize];
                match self.gap_once(pair as usize, 0.5 * size * p.reach[pair as usize]) {
                    Gap::Far => {}
                    Gap::Close => p.pairs_next.push(pair),
                    Gap::Touch => {
                        self.witness = Some(pair as usize);
                        return false;
                    }
                }
            }
            let last = p.pairs_next.len() as u32;
            if last > first {
                p.next.push(Piece { start: piece.start, first, last });
            }
        }
        true
    }

    /// Computes how much each pair can approach on a motion, unless that was the last one: a clearance is searched with
    /// many checks of the same motion.
    fn measure(&self, p: &mut Pieces, from: &[f64], to: &[f64]) {
        if p.measured[0] == from && p.measured[1] == to {
            return;
        }
        for (own, end) in p.measured.iter_mut().zip([from, to]) {
            own.clear();
            own.extend_from_slice(end);
        }
        let reach = |levers: &[f64]| {
            levers.iter().zip(from.iter().zip(to)).map(|(lever, (a, b))| lever * (b - a).abs()).sum::<f64>()
        };
        p.links.clear();
        p.links.extend(self.scene.links.iter().map(|link| reach(&link.levers)));
        for ((to, pair), link_pair) in p.reach.iter_mut().zip(&self.pairs).zip(&self.link_pairs) {
            *to = match *pair {
                Pair::Obstacle(link, _) => p.links[link],
                Pair::Links(..) => reach(&self.scene.pairs[*link_pair].levers),
            };
        }
    }
}

/// Computes a place on a motion.
fn place((from, to): (&[f64], &[f64]), at: f64, q: &mut [f64]) {
    for ((x, a), b) in q.iter_mut().zip(from).zip(to) {
        // Exact at the end.
        *x = if at == 1.0 { *b } else { a + (b - a) * at };
    }
}
