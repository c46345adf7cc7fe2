//! The robots and obstacles of the collision guard, prepared for the tick on another thread.

mod pieces;

use std::sync::Arc;

use dimos_kernels::block::Lanes;

use super::braking::JointStep;
use dimos_core::telemetry::{Guarded, Label};
use dimos_planner::collision::settings::GuardSettings;
use dimos_planner::collision::{OwnMargins, Scene, Sweep};
use pieces::{PARTS, Piece};

/// A pair that is not proven free on more pieces than these is looked for in conflict at their ends first.
const MANY: u32 = Sweep::PIECES as u32 / 4;
/// A pair that is closer than it was allowed to get by more than this was brought there by something else than the
/// guarded commands [m].
const CLOSER: f32 = 2e-5;
/// An arm at rest is released if the pair that stopped it keeps this much more than its margin, or comes no closer [m].
const RELEASE: f32 = 0.002;
/// Most of that, for a pair that stopped arms several times in a row [m].
const MOST_RELEASE: f32 = 0.032;
/// A pair that stops an arm within this many ticks after a release does so in a row.
const AGAIN: u64 = 100;
/// The same as [`RELEASE`] for links of one robot, which are close to each other by design [m].
const OWN_RELEASE: f32 = 0.0005;
/// How far beyond what a pair must keep a distance is searched that is only reported [m].
const AHEAD: f32 = 0.03;

/// The arms of pairs that are not kept apart, as bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Conflicts {
    /// Arms that one arm alone brings together: with an obstacle, or with itself.
    alone: u64,
    /// Arms that are in each other's way.
    together: u64,
    /// Whether all other pairs are proven free.
    pub are_all: bool,
}

impl Conflicts {
    /// Returns whether there are none.
    pub fn is_empty(self) -> bool {
        self.arms() == 0
    }

    /// Returns the arms.
    pub fn arms(self) -> u64 {
        self.alone | self.together
    }

    /// Returns the arms to brake: first all that need no other arm for it. Of arms that are in each other's way one:
    /// one that is stopped already, else one that follows a stream, in turn, so that each can move away from the other.
    /// Those that execute trajectories come last.
    pub fn to_brake(self, streaming: u64, resting: u64, executing: u64, turn: u64) -> u64 {
        let one = |arms: u64| match arms {
            0 => 0,
            _ if turn.is_multiple_of(2) => arms & arms.wrapping_neg(),
            _ => 1 << (63 - arms.leading_zeros()),
        };
        let (alone, together) = (self.alone & streaming, self.together & streaming);
        match (alone, together & resting, together) {
            (0, 0, 0) => self.together & executing,
            (0, 0, _) => one(together),
            (0, resting, _) => one(resting),
            _ => alone,
        }
    }
}

/// A snapshot of the world for the tick. Its buffers are as large as they will ever be.
#[derive(Debug)]
pub struct GuardWorld {
    sweep: Sweep,
    /// The coordinator's joint of each joint of the scene.
    joints: Vec<u16>,
    pairs: Vec<GuardedPair>,
    margins: Vec<f32>,
    /// Distance that each pair must keep now [m]: its margin, or less as long as it is closer.
    pads: Vec<f32>,
    /// The same in this tick.
    asked: Vec<f32>,
    /// Pairs with less than their margin.
    near: Vec<u32>,
    /// Pairs that stop an arm.
    holding: Vec<u32>,
    active: Vec<u32>,
    conflicts: Vec<u32>,
    steps: Vec<JointStep>,
    open: Vec<Piece>,
    next: Vec<Piece>,
    refined: Vec<u32>,
    edges: [f64; Sweep::PIECES + 1],
}

#[derive(Debug, Clone, Copy)]
struct GuardedPair {
    /// The arms that move its members relative to each other, as bits.
    arms: u64,
    names: [Label; 2],
    /// What it must keep beyond its margin before an arm that it stopped is released [m].
    release: f32,
    /// The tick in which it released an arm last.
    released: Option<u64>,
}

impl GuardWorld {
    /// Prepares a scene. `joints`: the coordinator's index of each joint of the scene; `arms`: the arm of each joint of
    /// the coordinator; `margin`: distance of links from obstacles and from other robots [m]; `own`: from links of
    /// their own robot.
    ///
    /// # Errors
    /// A description, if joints are missing, or arms are too many.
    pub fn new(
        scene: &Arc<Scene>,
        joints: Vec<u16>,
        arms: &[u16],
        margin: f64,
        own: &OwnMargins,
    ) -> Result<Self, String> {
        let sweep = Sweep::new(scene, &GuardSettings::default());
        if joints.len() != sweep.dof() {
            return Err(format!("{} of {} joints of its robots are commanded", joints.len(), sweep.dof()));
        }
        let bit = |joint: u32| {
            let arm = joints.get(joint as usize).and_then(|joint| arms.get(usize::from(*joint)));
            arm.and_then(|arm| 1u64.checked_shl(u32::from(*arm))).ok_or("it can guard 64 arms at most")
        };
        let mut pairs = Vec::with_capacity(sweep.pairs());
        for pair in 0..sweep.pairs() {
            let mut arms = 0;
            for (joint, _) in sweep.levers(pair) {
                arms |= bit(*joint)?;
            }
            let release = if sweep.is_of_one_robot(pair) { OWN_RELEASE } else { RELEASE };
            pairs.push(GuardedPair { arms, names: sweep.names(pair).map(Label::new), release, released: None });
        }
        let kept = |pair| match sweep.is_of_one_robot(pair) {
            true => own.get(sweep.names(pair)),
            false => (margin + sweep.apart(pair)) as f32,
        };
        let margins: Vec<f32> = (0..sweep.pairs()).map(kept).collect();
        let list = || Vec::with_capacity(margins.len());
        let pieces = || Vec::with_capacity(PARTS * Sweep::PIECES * margins.len());
        Ok(Self {
            steps: vec![JointStep::default(); sweep.dof()],
            near: list(),
            holding: list(),
            active: list(),
            conflicts: list(),
            refined: list(),
            open: pieces(),
            next: pieces(),
            edges: [0.0; Sweep::PIECES + 1],
            asked: margins.clone(),
            pads: margins.clone(),
            margins,
            pairs,
            joints,
            sweep,
        })
    }

    /// Takes over which pairs stop arms from the world that this one replaces.
    pub fn inherit(&mut self, old: &Self) {
        for before in old.holding.iter().filter_map(|index| old.pairs.get(*index as usize)) {
            let same = |pair: &GuardedPair| (pair.names, pair.arms) == (before.names, before.arms);
            let Some(index) = self.pairs.iter().position(same) else { continue };
            if let Some(pair) = self.pairs.get_mut(index) {
                (pair.release, pair.released) = (before.release, before.released);
            }
            if !self.holding.contains(&(index as u32)) {
                self.holding.push(index as u32);
            }
        }
    }

    /// Sets the step of each joint of the coordinator.
    pub fn set_steps(&mut self, step: impl Fn(u16) -> JointStep) {
        for (own, joint) in self.steps.iter_mut().zip(&self.joints) {
            *own = step(*joint);
        }
    }

    /// Lets pairs that are closer than their margin remain as close as they are where the coordinator's joints are now
    /// [rad]. Takes its time: the tick does it itself for the pairs that are in its way.
    pub fn allow_present(&mut self, position: impl Fn(u16) -> f64) {
        self.set_steps(|joint| JointStep::at(position(joint)));
        for pair in 0..self.pairs.len() as u32 {
            self.allow(pair);
        }
    }

    /// Finds the pairs that the motion does not keep apart, among those for which `asked` holds of their arms; with
    /// `any`, only those that stop an arm already if one of them does it again.
    pub fn find_conflicts(&mut self, dt: f64, any: bool, asked: impl Fn(u64) -> bool) -> Conflicts {
        self.conflicts.clear();
        self.active.clear();
        let active = self.pairs.iter().enumerate().filter(|(_, pair)| asked(pair.arms));
        self.active.extend(active.map(|(index, _)| index as u32));
        if self.active.is_empty() {
            return Conflicts::default();
        }
        self.divide();
        self.ask();
        self.refined.clear();
        if any {
            self.refined.extend(self.holding.iter().filter(|pair| self.active.contains(pair)));
            self.look_at_ends(dt);
        }
        let are_all = self.conflicts.is_empty();
        if are_all {
            self.find_all_conflicts(dt);
        }
        let mut found = Conflicts { are_all, ..Conflicts::default() };
        for pair in &self.conflicts {
            let arms = self.pairs.get(*pair as usize).map_or(0, |pair| pair.arms);
            *(if arms.is_power_of_two() { &mut found.alone } else { &mut found.together }) |= arms;
        }
        found
    }

    fn find_all_conflicts(&mut self, dt: f64) {
        self.place_pieces(dt);
        self.open.clear();
        self.refined.clear();
        let none = Lanes::splat(0.0);
        for (pair, pieces) in self.sweep.close(u16::MAX, &none, &self.asked, &self.active) {
            if pieces.count_ones() > MANY {
                self.refined.push(*pair);
            }
            for k in (0..Sweep::PIECES).filter(|k| pieces >> k & 1 == 1) {
                let edge = |k: usize| self.edges.get(k).copied().unwrap_or_default();
                self.open.push(Piece { from: edge(k), to: edge(k + 1), pair: *pair });
            }
        }
        self.look_at_ends(dt);
        self.refine(dt);
    }

    /// Returns the pair that is in the way of an arm, and its distance at the next setpoints [m].
    pub fn conflict_of(&mut self, arm: u64) -> Option<Guarded> {
        let of = |pair: &&u32| self.pairs.get(**pair as usize).is_some_and(|pair| pair.arms & arm != 0);
        let index = *self.conflicts.iter().find(of)?;
        let [link, other] = self.pairs.get(index as usize)?.names;
        // Beyond what it must keep, the distance is not searched.
        let distance = self.distance(index, 1.0, AHEAD).unwrap_or(0.0);
        Some(Guarded { link, other, distance: f64::from(distance) })
    }

    /// Lets the pairs in conflict remain as close as they are where something else than guarded commands brought them
    /// closer than they may be. Returns whether there were any.
    pub fn allow_conflicts(&mut self) -> bool {
        let mut any = false;
        for k in 0..self.conflicts.len() {
            let pair = self.conflicts.get(k).copied();
            any |= pair.is_some_and(|pair| self.allow(pair));
        }
        any
    }

    fn allow(&mut self, pair: u32) -> bool {
        // Most pairs are far: one look.
        self.place_still(0.0, 1);
        if !self.is_close(pair, -CLOSER) {
            return false;
        }
        let Some(distance) = self.distance(pair, 0.0, 0.0) else { return false };
        let Some(pad) = self.pads.get_mut(pair as usize).filter(|pad| distance < **pad) else { return false };
        *pad = distance;
        if !self.near.contains(&pair) {
            self.near.push(pair);
        }
        true
    }

    /// Restores the margin of pairs that keep it on the whole way. Called with the steps that are made.
    pub fn restore_margins(&mut self, dt: f64) {
        if self.near.is_empty() {
            return;
        }
        self.divide();
        self.place_pieces(dt);
        let close = self.sweep.close(u16::MAX, &Lanes::splat(0.0), &self.margins, &self.near);
        let (pads, margins) = (&mut self.pads, &self.margins);
        self.near.retain(|pair| {
            let remains = close.iter().any(|(other, _)| other == pair);
            if let (false, Some(pad), Some(margin)) =
                (remains, pads.get_mut(*pair as usize), margins.get(*pair as usize))
            {
                *pad = *margin;
            }
            remains
        });
    }

    /// Remembers the pairs in conflict as what stops these arms. A pair that released one just before is given more
    /// room: an arm does not approach in many small steps.
    pub fn hold(&mut self, arms: u64, tick: u64) {
        for index in &self.conflicts {
            let Some(pair) = self.pairs.get_mut(*index as usize).filter(|pair| pair.arms & arms != 0) else { continue };
            if !self.holding.contains(index) {
                if pair.released.is_some_and(|released| tick.saturating_sub(released) < AGAIN) {
                    pair.release = (2.0 * pair.release).min(MOST_RELEASE);
                } else {
                    pair.release = if self.sweep.is_of_one_robot(*index as usize) { OWN_RELEASE } else { RELEASE };
                }
                self.holding.push(*index);
            }
        }
    }

    /// Asks more than the margin of the pairs that stop arms, while these are at rest: they would stop again at once
    /// otherwise. Forgets the pairs of arms that are not stopped.
    pub fn widen(&mut self, stopped: u64, resting: u64, tick: u64) {
        let (pads, margins, pairs, near) = (&mut self.pads, &self.margins, &mut self.pairs, &self.near);
        self.holding.retain(|index| {
            let at = *index as usize;
            let (Some(pad), Some(margin), Some(pair)) = (pads.get_mut(at), margins.get(at), pairs.get_mut(at)) else {
                return false;
            };
            if !near.contains(index) {
                *pad = margin + if pair.arms & resting != 0 { pair.release } else { 0.0 };
            }
            let holds = pair.arms & stopped != 0;
            pair.released = if holds { None } else { Some(tick) };
            holds
        });
    }

    /// Sets what is asked of the pairs in this tick. Links of one robot are close to each other by design: their joints
    /// count where they are measured, whatever they may do until a velocity takes effect.
    fn ask(&mut self) {
        self.asked.copy_from_slice(&self.pads);
        if self.steps.iter().all(|step| step.spread == 0.0) {
            return;
        }
        for pair in self.active.iter().map(|pair| *pair as usize).filter(|pair| self.sweep.is_of_one_robot(*pair)) {
            let spread = |joint: &u32| self.steps.get(*joint as usize).map_or(0.0, |step| step.spread as f32);
            let way: f32 = self.sweep.levers(pair).iter().map(|(joint, lever)| lever * spread(joint)).sum();
            self.asked.get_mut(pair).into_iter().for_each(|asked| *asked -= way);
        }
    }

    /// Returns whether a pair may be closer than it must keep plus `margin` [m], where the pieces were set.
    fn is_close(&mut self, pair: u32, margin: f32) -> bool {
        !self.sweep.close(1, &Lanes::splat(margin), &self.pads, &[pair]).is_empty()
    }

    /// Returns the distance of a pair at a time [ticks] that covers prove, up to `ahead` more than it must keep [m];
    /// `None` if none is proven.
    fn distance(&mut self, pair: u32, time: f64, ahead: f32) -> Option<f32> {
        self.place_still(time, Sweep::PIECES);
        let pad = self.pads.get(pair as usize).copied()?;
        self.sweep.distance(pair, pad + ahead, &self.pads)
    }
}
