//! Rejects implausible measurements. A joint under power cannot move faster than its own top speed: a reading that
//! implies this is rejected, and the last accepted one stays. Three rejected readings that agree with each other are
//! accepted: the position jumped.

use crate::arm::ArmState;
use crate::clock::Mono;
use crate::joint::{Joints, MAX_DOF};

/// Factor on the top speed, for noise of the time stamps.
const SPEED_MARGIN: f64 = 1.5;
/// Noise of a position that is always accepted [rad].
const NOISE: f64 = 0.02;
/// Number of consecutive, consistent rejected readings that are a jump.
pub(super) const JUMP_AFTER: u32 = 3;
/// One turn [rad].
const TURN: f64 = std::f64::consts::TAU;

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
    /// [rad].
    Jumped(usize, f64),
}

/// Plausibility of the readings of one arm.
#[derive(Debug, Clone)]
pub struct Plausibility {
    dof: usize,
    /// The joints' own top speeds [rad/s].
    speed: Joints,
    /// Joints whose reading may be off by a whole turn: their range is at least one turn.
    turning: [bool; MAX_DOF],
    /// Shortest time between two readings [s].
    period: f64,
    seq: u64,
    enabled: bool,
    accepted: (Joints, Mono),
    rejected: u32,
    candidate: (Joints, Mono),
}

impl Plausibility {
    /// Creates it for joints with these top speeds [rad/s] and ranges [rad], read once per `period` [s].
    pub fn new(speed: &[f64], lower: &[f64], upper: &[f64], period: f64) -> Self {
        let mut turning = [false; MAX_DOF];
        for (turning, (lower, upper)) in turning.iter_mut().zip(lower.iter().zip(upper)) {
            *turning = upper - lower >= TURN - NOISE;
        }
        let none = ([0.0; MAX_DOF], Mono::ZERO);
        Self {
            dof: speed.len().min(MAX_DOF),
            speed: crate::joint::joints_of(speed),
            turning,
            period,
            seq: 0,
            enabled: false,
            accepted: none,
            rejected: 0,
            candidate: none,
        }
    }

    /// Returns the last accepted positions [rad].
    pub fn position(&self) -> &Joints {
        &self.accepted.0
    }

    /// Returns when they were measured.
    pub fn stamp(&self) -> Mono {
        self.accepted.1
    }

    /// Returns the number of readings rejected since then.
    pub fn rejected(&self) -> u32 {
        self.rejected
    }

    /// Takes a reading whose positions are finite.
    pub fn take(&mut self, state: &ArmState) -> Verdict {
        if state.seq == self.seq || state.seq == 0 {
            return Verdict::Same;
        }
        // Without power an arm may be moved by hand, at any speed.
        let checked = self.seq != 0 && self.enabled && state.enabled;
        (self.seq, self.enabled) = (state.seq, state.enabled);
        let reading = (state.position, state.stamp);
        let (joint, step) = match self.worst(&self.accepted, &reading) {
            Some(worst) if checked => worst,
            _ => {
                self.accept(reading);
                return Verdict::Accepted;
            }
        };
        let agrees = self.rejected > 0 && self.worst(&self.candidate, &reading).is_none();
        self.rejected = if agrees { self.rejected + 1 } else { 1 };
        self.candidate = reading;
        if self.rejected < JUMP_AFTER {
            return Verdict::Rejected;
        }
        self.accept(reading);
        Verdict::Jumped(joint, step)
    }

    fn accept(&mut self, reading: (Joints, Mono)) {
        self.accepted = reading;
        self.rejected = 0;
    }

    /// Returns the joint that exceeds its possible motion between two readings the most, and its step [rad].
    fn worst(&self, from: &(Joints, Mono), to: &(Joints, Mono)) -> Option<(usize, f64)> {
        let dt = to.1.seconds_since(from.1).max(self.period);
        let mut worst: Option<(usize, f64, f64)> = None;
        for j in 0..self.dof {
            let (Some(a), Some(b), Some(speed)) = (from.0.get(j), to.0.get(j), self.speed.get(j)) else { continue };
            let mut step = b - a;
            if step.abs() > TURN / 2.0 && self.turning.get(j).copied().unwrap_or(false) {
                step -= TURN * (step / TURN).round();
            }
            let beyond = step.abs() - (SPEED_MARGIN * speed * dt + NOISE);
            if beyond > 0.0 && worst.is_none_or(|(_, _, by)| beyond > by) {
                worst = Some((j, step, beyond));
            }
        }
        worst.map(|(j, step, _)| (j, step))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plausibility() -> Plausibility {
        Plausibility::new(&[2.0, 2.0], &[-3.0, -4.0], &[3.0, 4.0], 0.01)
    }

    fn reading(seq: u64, ms: u64, q: [f64; 2]) -> ArmState {
        let position = crate::joint::joints_of(&q);
        ArmState { seq, stamp: Mono(ms * 1_000_000), dof: 2, enabled: true, position, ..ArmState::default() }
    }

    #[test]
    fn a_single_wrong_reading_is_rejected_and_the_last_one_stays() {
        let mut b = plausibility();
        assert_eq!(b.take(&reading(1, 10, [0.5, 0.0])), Verdict::Accepted);
        assert_eq!(b.take(&reading(2, 20, [0.0, 0.0])), Verdict::Rejected);
        assert_eq!(b.take(&reading(2, 20, [0.0, 0.0])), Verdict::Same);
        assert_eq!((b.position()[0], b.stamp(), b.rejected()), (0.5, Mono(10_000_000), 1));
        assert_eq!(b.take(&reading(3, 30, [0.52, 0.0])), Verdict::Accepted);
        assert_eq!(b.rejected(), 0);
    }

    #[test]
    fn three_that_agree_are_a_jump_and_three_that_do_not_are_noise() {
        let mut b = plausibility();
        b.take(&reading(1, 10, [1.0, 0.5]));
        assert_eq!(b.take(&reading(2, 20, [0.0, 0.5])), Verdict::Rejected);
        assert_eq!(b.take(&reading(3, 30, [0.0, 0.5])), Verdict::Rejected);
        assert_eq!(b.take(&reading(4, 40, [0.01, 0.5])), Verdict::Jumped(0, -0.99));
        assert_eq!(b.position()[0], 0.01);
        for k in 0..20 {
            let q = if k % 2 == 0 { -1.5 } else { 1.5 };
            assert_eq!(b.take(&reading(5 + k, 50 + 10 * k, [q, 0.5])), Verdict::Rejected, "{k}");
        }
    }

    #[test]
    fn the_time_since_the_last_accepted_reading_counts() {
        let mut b = plausibility();
        b.take(&reading(1, 10, [0.0, 0.0]));
        assert_eq!(b.take(&reading(2, 210, [0.55, 0.0])), Verdict::Accepted, "0.2 s at 2 rad/s");
        assert_eq!(b.take(&reading(3, 211, [0.59, 0.0])), Verdict::Accepted, "at least one period");
    }

    #[test]
    fn without_power_an_arm_may_be_moved_by_hand() {
        let mut b = plausibility();
        b.take(&ArmState { enabled: false, ..reading(1, 10, [0.0, 0.0]) });
        assert_eq!(b.take(&ArmState { enabled: false, ..reading(2, 20, [1.0, 0.0]) }), Verdict::Accepted);
        assert_eq!(b.take(&reading(3, 30, [2.0, 0.0])), Verdict::Accepted, "just enabled");
        assert_eq!(b.take(&reading(4, 40, [1.0, 0.0])), Verdict::Rejected);
    }

    #[test]
    fn a_joint_of_a_whole_turn_may_pass_pi() {
        let mut b = plausibility();
        b.take(&reading(1, 10, [0.0, 3.13]));
        assert_eq!(b.take(&reading(2, 20, [0.0, -3.13])), Verdict::Accepted);
        assert_eq!(b.take(&reading(3, 30, [0.0, -2.0])), Verdict::Rejected);
    }
}
