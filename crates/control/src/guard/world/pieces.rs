//! The motion in pieces: how it is divided among lanes, and refined where a pair is not proven free.

use dimos_kernels::block::Lanes;

use super::GuardWorld;
use crate::guard::JointStep;
use dimos_planner::collision::Sweep;

/// Most refinements of one check, each with sixteen pieces: what is not proven free by then is not free.
const REFINEMENTS: usize = 8;
/// A piece on which a pair approaches from its middle by less than this is not refined further: it is free if the pair
/// keeps its distance at the end [m]. So an arm at the margin is not kept from leaving by what it might do on the way.
const FINEST: f64 = 0.0003;
/// What rounding may take off a distance [m].
const ROUNDING: f32 = 1e-5;
/// Parts into which a piece is refined.
pub(super) const PARTS: usize = 4;
/// Pieces that are refined together.
const BATCH: usize = Sweep::PIECES / PARTS;

/// A piece of the motion on which a pair is not proven free: from, to [ticks].
#[derive(Debug, Clone, Copy)]
pub(super) struct Piece {
    pub from: f64,
    pub to: f64,
    pub pair: u32,
}

impl Piece {
    /// Returns its parts: their lanes in a slot of a batch, and their times.
    fn parts(self, slot: usize) -> impl Iterator<Item = (usize, f64, f64)> {
        let part = (self.to - self.from) / PARTS as f64;
        let at = move |i: usize| self.from + part * i as f64;
        (0..PARTS).map(move |i| (PARTS * slot + i, at(i), at(i + 1)))
    }
}

impl GuardWorld {
    /// Divides the motion: the step to the next setpoints, and the braking path into pieces of about equal length.
    pub(super) fn divide(&mut self) {
        let ticks = self.steps.iter().map(JointStep::ticks).fold(1.0, f64::max);
        let braking = (Sweep::PIECES - 1) as f64;
        for (k, edge) in self.edges.iter_mut().enumerate().skip(1) {
            *edge = 1.0 + (ticks - 1.0) * (1.0 - (1.0 - (k as f64 - 1.0) / braking).max(0.0).sqrt());
        }
    }

    /// Sets the pieces of the divided motion.
    pub(super) fn place_pieces(&mut self, dt: f64) {
        for (joint, step) in self.steps.iter().enumerate() {
            let at = step.course(dt);
            // It never turns back on the way.
            let mut a = at(0.0);
            for (piece, edge) in self.edges.iter().skip(1).enumerate() {
                let b = at(*edge);
                self.sweep.set(piece, joint, 0.5 * (a + b), 0.5 * (b - a).abs() + step.spread);
                a = b;
            }
        }
    }

    /// Sets a piece of the motion, for those joints whose bits are set.
    fn place(&mut self, piece: usize, (from, to): (f64, f64), joints: u64, dt: f64) {
        for (joint, step) in self.steps.iter().enumerate().filter(|(joint, _)| joints >> joint.min(&63) & 1 == 1) {
            let at = step.course(dt);
            let (a, b) = (at(from), at(to));
            self.sweep.set(piece, joint, 0.5 * (a + b), 0.5 * (b - a).abs() + step.spread);
        }
    }

    /// Returns the joints that move the members of a pair relative to each other, as bits; the last bit is that of all
    /// beyond.
    fn joints_of(&self, pair: u32) -> u64 {
        self.sweep.levers(pair as usize).iter().fold(0, |all, (joint, _)| all | 1 << joint.min(&63))
    }

    /// Sets the first `pieces` to the same time, without motion, and where the joints most likely are.
    pub(super) fn place_still(&mut self, time: f64, pieces: usize) {
        for (joint, step) in self.steps.iter().enumerate() {
            let q = step.from + (step.to - step.from) * time;
            (0..pieces).for_each(|piece| self.sweep.set(piece, joint, q, 0.0));
        }
    }

    /// Finds pairs in conflict among the refined ones: those that are too close at the end of a piece. They need no
    /// refinement.
    pub(super) fn look_at_ends(&mut self, dt: f64) {
        if self.refined.is_empty() {
            return;
        }
        for (joint, step) in self.steps.iter().enumerate() {
            let at = step.course(dt);
            for (piece, edge) in self.edges.iter().skip(1).enumerate() {
                self.sweep.set(piece, joint, at(*edge), step.spread);
            }
        }
        let close = self.sweep.close(u16::MAX, &Lanes::splat(-ROUNDING), &self.asked, &self.refined);
        self.conflicts.extend(close.iter().map(|(pair, _)| *pair));
    }

    /// Refines the open pieces, a batch at a time, until they are proven free or in conflict.
    pub(super) fn refine(&mut self, dt: f64) {
        let mut left = REFINEMENTS;
        while !self.open.is_empty() {
            self.next.clear();
            for at in (0..self.open.len()).step_by(BATCH) {
                left -= usize::from(self.refine_batch(at, left, dt));
            }
            std::mem::swap(&mut self.open, &mut self.next);
        }
    }

    /// Refines the open pieces from `at` on. Returns whether it needed a check; with none `left` all are in conflict.
    fn refine_batch(&mut self, at: usize, left: usize, dt: f64) -> bool {
        self.refined.clear();
        let mut joints = 0;
        for slot in 0..BATCH {
            let Some(piece) = self.open.get(at + slot) else { continue };
            if self.conflicts.contains(&piece.pair) {
                continue;
            }
            if left == 0 {
                self.conflicts.push(piece.pair);
            } else if !self.refined.contains(&piece.pair) {
                self.refined.push(piece.pair);
                joints |= self.joints_of(piece.pair);
            }
        }
        if self.refined.is_empty() {
            return false;
        }
        let mut margin = Lanes::splat(0.0);
        let mut ends = [false; BATCH];
        for (slot, end) in ends.iter_mut().enumerate() {
            let Some(piece) = self.open.get(at + slot).copied() else { continue };
            if !self.refined.contains(&piece.pair) {
                continue;
            }
            *end = self.approach(&piece, dt) <= FINEST;
            for (lane, from, to) in piece.parts(slot) {
                if *end {
                    self.place(lane, (piece.to, piece.to), joints, dt);
                    margin.0.get_mut(lane).into_iter().for_each(|margin| *margin = -ROUNDING);
                } else {
                    self.place(lane, (from, to), joints, dt);
                }
            }
        }
        let close = self.sweep.close(u16::MAX, &margin, &self.asked, &self.refined);
        for (slot, end) in ends.into_iter().enumerate() {
            let Some(piece) = self.open.get(at + slot) else { continue };
            let Some((_, lanes)) = close.iter().find(|(pair, _)| *pair == piece.pair) else { continue };
            for (_, from, to) in piece.parts(slot).filter(|(lane, ..)| lanes >> lane & 1 == 1) {
                if !end {
                    self.next.push(Piece { from, to, pair: piece.pair });
                } else if !self.conflicts.contains(&piece.pair) {
                    self.conflicts.push(piece.pair);
                }
            }
        }
        true
    }

    /// Returns how far a pair approaches on a piece at most, from its middle [m].
    fn approach(&self, piece: &Piece, dt: f64) -> f64 {
        let way = |joint: &u32| {
            let step = self.steps.get(*joint as usize);
            step.map_or(0.0, |step| 0.5 * (step.position(piece.to, dt) - step.position(piece.from, dt)).abs())
        };
        self.sweep.levers(piece.pair as usize).iter().map(|(joint, lever)| f64::from(*lever) * way(joint)).sum()
    }
}
