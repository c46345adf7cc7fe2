//! The collision guard: arms that follow streams keep a way to rest that is proven free of contacts.
//!
//! Each tick proves the step to the next setpoints, and the braking path from them, of all arms at the same time. An
//! arm for which there is no proof decelerates instead: along the path that was proven in the tick before. So a free
//! braking path always remains. Once at rest, the arm follows its stream again when that leads away from what is in the
//! way.

mod braking;
mod world;

pub use braking::JointStep;
pub use world::GuardWorld;

use dimos_core::telemetry::Guarded;

/// Most checks in one tick. Then all arms that follow streams decelerate.
const ROUNDS: usize = 4;
/// Checks that may end with the first pair that stopped an arm before; later ones find all.
const FEW: usize = 2;
/// Most checks for pairs that something else brought too close.
const ALLOWANCES: usize = 2;

/// Ticks after which the distance is measured again of what stops an arm: it is only reported.
const REPORT: u64 = 16;

/// Verdict on an arm: `Some` decelerates it.
pub type Verdict = Option<Guarded>;

/// What moves an arm in a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Movement {
    /// Its position is unknown: it is not checked.
    #[default]
    Unknown,
    /// A stream: guarded.
    Stream,
    /// A trajectory: not guarded, but the arms that follow streams are kept apart from it.
    Trajectory,
    /// Nothing, or a deceleration to rest.
    Other,
}

/// The guard of all arms.
#[derive(Debug)]
pub struct Guard {
    world: Option<Box<GuardWorld>>,
    /// The arms whose commands were sent, as bits.
    sent: u64,
    movements: Vec<Movement>,
    verdicts: Vec<Verdict>,
    /// Arms with a new verdict, as bits.
    changed: u64,
    ticks: u64,
}

impl Guard {
    /// Creates the guard of this number of arms, without a world: nothing is guarded.
    pub fn new(arms: usize) -> Self {
        Self {
            world: None,
            sent: 0,
            movements: vec![Movement::Unknown; arms],
            verdicts: vec![None; arms],
            changed: 0,
            ticks: 0,
        }
    }

    /// Replaces the world. Returns the one before.
    pub fn set_world(&mut self, mut world: Option<Box<GuardWorld>>) -> Option<Box<GuardWorld>> {
        if let (Some(new), Some(old)) = (&mut world, &self.world) {
            new.inherit(old);
        }
        std::mem::replace(&mut self.world, world)
    }

    /// Returns whether it judges.
    pub fn decides(&self) -> bool {
        self.world.is_some()
    }

    /// Takes the verdict of a recorded tick.
    pub fn give(&mut self, arm: u16, verdict: Verdict) {
        if let Some(own) = self.verdicts.get_mut(usize::from(arm)) {
            *own = verdict;
            self.changed |= bit(usize::from(arm));
        }
    }

    /// Notes whether the commands of an arm were sent in this tick.
    pub fn note(&mut self, arm: usize, sent: bool) {
        self.sent = if sent { self.sent | bit(arm) } else { self.sent & !bit(arm) };
    }

    /// Sets what moves an arm in this tick.
    pub fn set(&mut self, arm: usize, movement: Movement) {
        if let Some(own) = self.movements.get_mut(arm) {
            *own = movement;
        }
    }

    /// Returns the new verdict on an arm, once.
    pub fn change(&mut self, arm: usize) -> Option<Verdict> {
        let changed = self.changed & bit(arm) != 0;
        self.changed &= !bit(arm);
        self.verdicts.get(arm).copied().filter(|_| changed)
    }

    /// Returns what blocks an arm.
    pub fn blocked(&self, arm: u16) -> Verdict {
        self.verdicts.get(usize::from(arm)).copied().flatten()
    }

    /// Judges all arms. `step` returns the step of a joint (over all arms), where arms whose bits are set brake;
    /// `at_rest`, whether an arm was at rest before this tick.
    pub fn judge(&mut self, dt: f64, step: impl Fn(u16, u64) -> Option<JointStep>, at_rest: impl Fn(usize) -> bool) {
        self.ticks = self.ticks.wrapping_add(1);
        let of = |movement| {
            let arms = self.movements.iter().enumerate().filter(move |(_, own)| **own == movement);
            arms.fold(0, |all, (arm, _)| all | bit(arm))
        };
        let unknown = of(Movement::Unknown);
        let streaming = of(Movement::Stream) & self.sent;
        let executing = of(Movement::Trajectory) & self.sent;
        let blocked = self.bits(|verdict| verdict.is_some()) & streaming;
        let resting = self.bits_where(&at_rest) & blocked;
        let mut braking = blocked & !resting;
        let Some(world) = &mut self.world else { return };
        let mut found = [None; 64];
        if streaming != 0 {
            world.widen(blocked, resting, self.ticks);
            let (mut rounds, mut allowances) = (0, 0);
            // Arms that are not proven free of conflicts with what they do now.
            let mut open = u64::MAX;
            loop {
                world.set_steps(|joint| step(joint, braking).unwrap_or_default());
                // What brakes on its proven path needs no proof, unless something else moves towards it.
                let moving = (streaming | executing) & !braking;
                let asked =
                    |arms: u64| arms & streaming != 0 && arms & moving != 0 && arms & unknown == 0 && arms & open != 0;
                let conflicts = world.find_conflicts(dt, rounds < FEW, asked);
                if conflicts.is_empty() {
                    break;
                }
                if conflicts.are_all {
                    open = conflicts.arms();
                }
                if allowances < ALLOWANCES && world.allow_conflicts() {
                    allowances += 1;
                    continue;
                }
                let hit = conflicts.to_brake(streaming & !braking, resting, executing & !braking, self.ticks);
                rounds += 1;
                let hit = if rounds > ROUNDS { (streaming | executing & conflicts.arms()) & !braking } else { hit };
                let ticks = self.ticks;
                let is_new = |arm: usize| {
                    let before = self.verdicts.get(arm).is_some_and(Option::is_some);
                    !before || (ticks + arm as u64).is_multiple_of(REPORT)
                };
                for (arm, found) in found.iter_mut().enumerate().filter(|(arm, _)| hit & bit(*arm) != 0) {
                    *found = is_new(arm).then(|| world.conflict_of(bit(arm)).unwrap_or_default());
                }
                world.hold(hit, self.ticks);
                braking |= hit;
                open |= hit;
                if hit == 0 || rounds > ROUNDS {
                    break;
                }
            }
            world.set_steps(|joint| step(joint, braking).unwrap_or_default());
            world.restore_margins(dt);
        }
        for (arm, (own, found)) in self.verdicts.iter_mut().zip(found).enumerate() {
            let before = *own;
            let brakes = braking & bit(arm) != 0;
            *own = if brakes { found.or(before) } else { None };
            if own.is_some() != before.is_some() {
                self.changed |= bit(arm);
            }
        }
    }

    fn bits(&self, is: impl Fn(&Verdict) -> bool) -> u64 {
        let arms = self.verdicts.iter().enumerate().filter(|(_, verdict)| is(verdict));
        arms.fold(0, |all, (arm, _)| all | bit(arm))
    }

    fn bits_where(&self, is: impl Fn(usize) -> bool) -> u64 {
        (0..self.verdicts.len()).filter(|arm| is(*arm)).fold(0, |all, arm| all | bit(arm))
    }
}

/// The bit of an arm; none beyond 64 arms, which [`GuardWorld::new`] refuses.
fn bit(arm: usize) -> u64 {
    1u64.checked_shl(arm as u32).unwrap_or(0)
}
