//! Rejects implausible measurements. A joint under power goes where its setpoints go, and no farther than its top speed
//! takes it between two readings: a reading that implies more is rejected, and the last accepted one stays. The
//! allowance does not grow while readings are rejected. Rejected ones that agree with each other for some time are a
//! jump; the last accepted one still stays, until an operator's reset.

use super::setpoints::Range;
use dimos_core::arm::{ArmState, Topology};
use dimos_core::clock::Mono;
use dimos_core::joint::{Joints, MAX_DOF, joints_of};

/// Factor on the top speed, for noise of the time stamps.
const SPEED_MARGIN: f64 = 1.5;
/// Noise of a position that is always accepted [rad].
const NOISE: f64 = 0.02;
/// Fastest that a hand moves a joint whose motor is off [rad/s], and highest acceleration of that [rad/s²].
const HAND_SPEED: f64 = 20.0;
const HAND_ACCELERATION: f64 = 400.0;
/// Highest acceleration of a joint under power that is pushed off its setpoints [rad/s²].
const PUSH_ACCELERATION: f64 = 100.0;
/// Longest time between two readings that counts: the arm may have moved meanwhile [s].
const LONGEST_GAP: f64 = 0.5;
/// Rejected readings that agree for this time are a jump: three of them at 100 Hz, two of a slower arm [s].
pub(super) const CONFIRMED: f64 = 0.015;
/// One turn [rad].
pub const TURN: f64 = std::f64::consts::TAU;
/// Largest position of an endless joint [rad].
const ENDLESS_RANGE: f64 = 1e4;

/// Result for a reading.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Verdict {
    /// No new reading.
    Same,
    /// It is plausible.
    Accepted,
    /// It is implausible: the last accepted reading stays.
    Rejected,
    /// It is confirmed, although the arm cannot have moved that far: the joint that jumped furthest, and its step
    /// [rad]. The last accepted reading stays.
    Jumped(usize, f64),
    /// It is confirmed, and off by whole turns: the joint, and its step [rad].
    TurnLost(usize, f64),
    /// Position and velocity of a joint contradict each other by this much [rad].
    Inconsistent(usize, f64),
}

/// Plausibility of the readings of one arm.
#[derive(Debug, Clone)]
pub struct Plausibility {
    dof: usize,
    /// The joints' own top speeds [rad/s].
    speed: Joints,
    topology: [Topology; MAX_DOF],
    /// Positions beyond these are no measurement: a turn outside of the joint's range [rad].
    lowest: Joints,
    highest: Joints,
    /// Shortest time between two readings [s].
    period: f64,
    seq: u64,
    enabled: bool,
    accepted: (Joints, Mono),
    /// Velocities between the last two accepted readings [rad/s].
    velocity: Joints,
    /// When the newest reading was measured, accepted or not.
    newest: Mono,
    /// When the first of the rejected readings that agree with the newest one was measured; `None`: it was accepted.
    rejected: Option<Mono>,
    candidate: (Joints, Mono),
}

impl Plausibility {
    /// Creates it for joints with these top speeds [rad/s] and ranges [rad], read once per `period` [s].
    pub fn new(speed: &[f64], lower: &[f64], upper: &[f64], topology: [Topology; MAX_DOF], period: f64) -> Self {
        let none = ([0.0; MAX_DOF], Mono::ZERO);
        let (mut lowest, mut highest) = (joints_of(lower), joints_of(upper));
        for ((lowest, highest), topology) in lowest.iter_mut().zip(&mut highest).zip(topology) {
            (*lowest, *highest) = match topology {
                Topology::Endless => (-ENDLESS_RANGE, ENDLESS_RANGE),
                _ => (*lowest - TURN, *highest + TURN),
            };
        }
        Self {
            dof: speed.len().min(MAX_DOF),
            speed: joints_of(speed),
            topology,
            lowest,
            highest,
            period,
            seq: 0,
            enabled: false,
            accepted: none,
            velocity: [0.0; MAX_DOF],
            newest: Mono::ZERO,
            rejected: None,
            candidate: none,
        }
    }

    /// Returns when the last accepted positions were measured.
    pub fn stamp(&self) -> Mono {
        self.accepted.1
    }

    /// Returns for how long readings that agree were rejected [s]; `None` if the newest one was accepted.
    pub fn rejected_for(&self) -> Option<f64> {
        self.rejected.map(|since| self.newest.seconds_since(since))
    }

    /// The next reading is accepted, wherever it is, unless it is no position of the joint at all: an operator has seen
    /// it, or the connection is new.
    pub fn acknowledge(&mut self) {
        (self.enabled, self.rejected) = (false, None);
        self.newest = Mono::ZERO;
    }

    /// Takes a reading. `range`: the setpoints that the arm may be following.
    pub fn take(&mut self, state: &ArmState, range: Option<&Range>) -> Verdict {
        if state.seq == self.seq || state.seq == 0 {
            return Verdict::Same;
        }
        let first = self.newest == Mono::ZERO;
        let powered = self.enabled && state.enabled;
        let time = if first { 0.0 } else { state.stamp.seconds_since(self.newest) };
        let dt = time.max(self.period).min(LONGEST_GAP);
        (self.seq, self.enabled, self.newest) = (state.seq, state.enabled, state.stamp);
        let reading = (state.position, state.stamp);
        let absurd = self.absurd(&reading.0);
        let worst = match absurd {
            Some(joint) => Some((joint, self.step(joint, &reading.0))),
            None if first => None,
            None => self.worst(&self.accepted.0, &reading.0, range.filter(|_| powered), powered, dt, true),
        };
        let Some((joint, step)) = worst else {
            let pairs = reading.0.iter().zip(&self.accepted.0);
            for (v, (now, before)) in self.velocity.iter_mut().zip(pairs) {
                *v = if first { 0.0 } else { (now - before) / dt };
            }
            self.accepted = reading;
            self.rejected = None;
            return Verdict::Accepted;
        };
        let finite = reading.0.iter().take(self.dof).all(|q| q.is_finite());
        let agrees = finite
            && self.rejected.is_some()
            && self.worst(&self.candidate.0, &reading.0, None, powered, dt, false).is_none();
        let since = self.rejected.filter(|_| agrees).unwrap_or(state.stamp);
        (self.rejected, self.candidate) = (Some(since), reading);
        if state.stamp.seconds_since(since) < CONFIRMED {
            return Verdict::Rejected;
        }
        if absurd.is_none() && self.is_turn(joint, step) {
            return Verdict::TurnLost(joint, step);
        }
        Verdict::Jumped(joint, step)
    }

    /// Returns whether a step of a joint is whole turns [rad].
    pub fn is_turn(&self, joint: usize, step: f64) -> bool {
        let turns = (step / TURN).round();
        let counts = self.topology.get(joint).is_some_and(|topology| *topology != Topology::Endless);
        counts && turns != 0.0 && (step - turns * TURN).abs() <= 0.5
    }

    fn step(&self, joint: usize, to: &Joints) -> f64 {
        let at = |joints: &Joints| joints.get(joint).copied().unwrap_or_default();
        at(to) - at(&self.accepted.0)
    }

    /// Returns the first joint that no joint of the arm can be at: not finite, or more than a turn outside its range.
    fn absurd(&self, at: &Joints) -> Option<usize> {
        let ranges = self.lowest.iter().zip(&self.highest);
        at.iter().zip(ranges).take(self.dof).position(|(q, (low, high))| !(low..=high).contains(&q))
    }

    /// Returns the joint that exceeds its possible motion between two readings the most, and its step [rad]. Between
    /// where it was and its setpoints a joint may be anywhere. `steady`: it had the velocity of the accepted readings.
    fn worst(
        &self,
        from: &Joints,
        to: &Joints,
        range: Option<&Range>,
        powered: bool,
        dt: f64,
        steady: bool,
    ) -> Option<(usize, f64)> {
        let mut worst: Option<(usize, f64, f64)> = None;
        for j in 0..self.dof {
            let (Some(a), Some(b), Some(speed)) = (from.get(j), to.get(j), self.speed.get(j)) else { continue };
            let (low, high) = match range {
                Some(range) => (range.low(j).min(*a), range.high(j).max(*a)),
                None => (*a, *a),
            };
            let beyond = (low - b).max(b - high).max(0.0);
            let (top, acceleration) = match powered {
                true => (SPEED_MARGIN * speed, PUSH_ACCELERATION),
                false => (HAND_SPEED, HAND_ACCELERATION),
            };
            let before = self.velocity.get(j).map_or(0.0, |v| v.abs());
            let fastest = if steady { (before + acceleration * dt).min(top) } else { top };
            let reach = fastest * dt + NOISE;
            let excess = beyond - reach;
            if excess > 0.0 && worst.is_none_or(|(_, _, by)| excess > by) {
                worst = Some((j, b - a, excess));
            }
        }
        worst.map(|(j, step, _)| (j, step))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plausibility() -> Plausibility {
        let topology = [Topology::MultiTurn; MAX_DOF];
        Plausibility::new(&[2.0, 2.0], &[-3.0, -4.0], &[3.0, 4.0], topology, 0.01)
    }

    fn reading(seq: u64, ms: u64, q: [f64; 2]) -> ArmState {
        let position = joints_of(&q);
        ArmState { seq, stamp: Mono(ms * 1_000_000), dof: 2, enabled: true, position, ..ArmState::default() }
    }

    fn range(low: f64, high: f64) -> Range {
        Range { low: joints_of(&[low, 0.0]), high: joints_of(&[high, 0.0]) }
    }

    #[test]
    fn a_single_wrong_reading_is_rejected_and_the_last_one_stays() {
        let mut b = plausibility();
        assert_eq!(b.take(&reading(1, 10, [0.5, 0.0]), None), Verdict::Accepted);
        assert_eq!(b.take(&reading(2, 20, [0.0, 0.0]), None), Verdict::Rejected);
        assert_eq!(b.take(&reading(2, 20, [0.0, 0.0]), None), Verdict::Same);
        assert_eq!((b.accepted.0[0], b.stamp(), b.rejected_for()), (0.5, Mono(10_000_000), Some(0.0)));
        assert_eq!(b.take(&reading(3, 30, [0.52, 0.0]), None), Verdict::Accepted);
        assert_eq!(b.rejected_for(), None);
    }

    #[test]
    fn three_that_agree_are_a_jump_that_stays_one_and_three_that_do_not_are_noise() {
        let mut b = plausibility();
        b.take(&reading(1, 10, [1.0, 0.5]), None);
        assert_eq!(b.take(&reading(2, 20, [0.0, 0.5]), None), Verdict::Rejected);
        assert_eq!(b.take(&reading(3, 30, [0.0, 0.5]), None), Verdict::Rejected);
        assert_eq!(b.take(&reading(4, 40, [0.01, 0.5]), None), Verdict::Jumped(0, -0.99));
        assert_eq!(b.take(&reading(5, 50, [0.01, 0.5]), None), Verdict::Jumped(0, -0.99), "however long it lasts");
        assert_eq!(b.accepted.0[0], 1.0);
        for k in 0..20 {
            let q = if k % 2 == 0 { -1.5 } else { 2.5 };
            assert_eq!(b.take(&reading(6 + k, 60 + 10 * k, [q, 0.5]), None), Verdict::Rejected, "{k}");
        }
        b.acknowledge();
        assert_eq!(b.take(&reading(30, 900, [-1.5, 0.5]), None), Verdict::Accepted);
    }

    #[test]
    fn the_allowance_grows_while_no_reading_comes_and_not_while_they_are_rejected() {
        let mut b = plausibility();
        b.take(&reading(1, 10, [0.0, 0.0]), None);
        assert_eq!(b.take(&reading(2, 210, [0.55, 0.0]), None), Verdict::Accepted, "0.2 s at 2 rad/s");
        for k in 0..30 {
            let verdict = b.take(&reading(3 + k, 220 + 10 * k, [0.85, 0.0]), None);
            assert!(!matches!(verdict, Verdict::Accepted), "{k}: {verdict:?}");
        }
    }

    #[test]
    fn what_setpoints_explain_is_plausible_at_any_speed_and_nothing_beyond_them() {
        let mut b = plausibility();
        b.take(&reading(1, 10, [0.0, 0.0]), None);
        assert_eq!(b.take(&reading(2, 20, [0.4, 0.0]), Some(&range(0.3, 0.5))), Verdict::Accepted);
        assert_eq!(b.take(&reading(3, 30, [0.56, 0.0]), Some(&range(0.4, 0.5))), Verdict::Rejected);
        assert_eq!(b.take(&reading(4, 40, [0.34, 0.0]), Some(&range(0.4, 0.5))), Verdict::Rejected);
    }

    #[test]
    fn without_power_an_arm_may_be_moved_by_hand_and_loses_no_turn() {
        let mut b = plausibility();
        let off = |state| ArmState { enabled: false, ..state };
        b.take(&off(reading(1, 10, [0.0, 0.0])), None);
        assert_eq!(b.take(&off(reading(2, 20, [0.05, 0.0])), None), Verdict::Accepted);
        assert_eq!(b.take(&off(reading(3, 30, [0.15, 0.0])), None), Verdict::Accepted, "5 rad/s, then 10");
        let turned = |k: u64| off(reading(4 + k, 40 + 10 * k, [0.15 + TURN, 0.0]));
        assert_eq!(
            [0, 1, 2].map(|k| b.take(&turned(k), None)),
            [Verdict::Rejected, Verdict::Rejected, Verdict::TurnLost(0, TURN)]
        );
    }

    #[test]
    fn a_position_that_no_joint_has_is_never_accepted() {
        let mut b = plausibility();
        for (k, q) in [f64::NAN, f64::INFINITY, 1e308, -9.3].into_iter().enumerate() {
            let verdict = b.take(&reading(1 + k as u64, 10 + 10 * k as u64, [q, 0.0]), None);
            assert!(!matches!(verdict, Verdict::Accepted), "{q}: {verdict:?}");
        }
        let mut endless = Plausibility::new(&[2.0], &[-3.0], &[3.0], [Topology::Endless; MAX_DOF], 0.01);
        assert_eq!(endless.take(&reading(1, 10, [600.0, 0.0]), None), Verdict::Accepted);
        assert_eq!(endless.take(&reading(2, 20, [1.1e4, 0.0]), None), Verdict::Rejected);
    }
}
