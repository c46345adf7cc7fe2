//! Which measurements are believed. A joint under power cannot be further from its last believed position than its own
//! top speed allows: a reading that says so is refused, and the last one stays. Three refused readings that agree with
//! each other are where the arm is: it jumped.

use crate::arm::ArmState;
use crate::clock::Mono;
use crate::joint::{Joints, MAX_DOF};

/// How much faster than its top speed a joint may seem, for noise of the stamps.
const SPEED_MARGIN: f64 = 1.5;
/// Noise of a position that is believed at any time [rad].
const NOISE: f64 = 0.02;
/// Refused readings in a row, consistent with each other, that are a jump.
const JUMP_AFTER: u32 = 3;
/// One turn [rad].
const TURN: f64 = std::f64::consts::TAU;

/// What becomes of a reading.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Verdict {
    /// Nothing new was read.
    Same,
    /// It is where the arm is.
    Believed,
    /// The arm cannot be there: the last believed reading stays.
    Refused,
    /// The arm is there, further than it can have moved: the joint that jumped furthest, and how far [rad].
    Jumped(usize, f64),
}

/// The last believed reading of one arm, and the refused ones after it.
#[derive(Debug, Clone)]
pub struct Belief {
    dof: usize,
    /// The joints' own top speeds [rad/s].
    speed: Joints,
    /// Joints whose measurement may be off by a whole turn: their range is at least one turn.
    turning: [bool; MAX_DOF],
    /// Shortest time between two readings [s].
    period: f64,
    seq: u64,
    enabled: bool,
    believed: (Joints, Mono),
    refused: u32,
    candidate: (Joints, Mono),
}

impl Belief {
    /// For joints with these top speeds [rad/s] and ranges [rad], read once in a `period` [s].
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
            believed: none,
            refused: 0,
            candidate: none,
        }
    }

    /// The last believed positions [rad].
    pub fn position(&self) -> &Joints {
        &self.believed.0
    }

    /// When they were measured.
    pub fn stamp(&self) -> Mono {
        self.believed.1
    }

    /// Readings refused since then.
    pub fn refused(&self) -> u32 {
        self.refused
    }

    /// Takes a reading whose positions are finite.
    pub fn take(&mut self, state: &ArmState) -> Verdict {
        if state.seq == self.seq || state.seq == 0 {
            return Verdict::Same;
        }
        // Without power an arm may be moved by hand, as fast as one likes.
        let checked = self.seq != 0 && self.enabled && state.enabled;
        (self.seq, self.enabled) = (state.seq, state.enabled);
        let reading = (state.position, state.stamp);
        let (joint, step) = match self.worst(&self.believed, &reading) {
            Some(worst) if checked => worst,
            _ => {
                self.believe(reading);
                return Verdict::Believed;
            }
        };
        let agrees = self.refused > 0 && self.worst(&self.candidate, &reading).is_none();
        self.refused = if agrees { self.refused + 1 } else { 1 };
        self.candidate = reading;
        if self.refused < JUMP_AFTER {
            return Verdict::Refused;
        }
        self.believe(reading);
        Verdict::Jumped(joint, step)
    }

    fn believe(&mut self, reading: (Joints, Mono)) {
        self.believed = reading;
        self.refused = 0;
    }

    /// The joint that is furthest beyond what it can have moved between two readings, and its step [rad].
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

    fn belief() -> Belief {
        Belief::new(&[2.0, 2.0], &[-3.0, -4.0], &[3.0, 4.0], 0.01)
    }

    fn reading(seq: u64, ms: u64, q: [f64; 2]) -> ArmState {
        let position = crate::joint::joints_of(&q);
        ArmState { seq, stamp: Mono(ms * 1_000_000), dof: 2, enabled: true, position, ..ArmState::default() }
    }

    #[test]
    fn a_single_wrong_reading_is_refused_and_the_last_one_stays() {
        let mut b = belief();
        assert_eq!(b.take(&reading(1, 10, [0.5, 0.0])), Verdict::Believed);
        assert_eq!(b.take(&reading(2, 20, [0.0, 0.0])), Verdict::Refused);
        assert_eq!(b.take(&reading(2, 20, [0.0, 0.0])), Verdict::Same);
        assert_eq!((b.position()[0], b.stamp(), b.refused()), (0.5, Mono(10_000_000), 1));
        assert_eq!(b.take(&reading(3, 30, [0.52, 0.0])), Verdict::Believed);
        assert_eq!(b.refused(), 0);
    }

    #[test]
    fn three_that_agree_are_a_jump_and_three_that_do_not_are_noise() {
        let mut b = belief();
        b.take(&reading(1, 10, [1.0, 0.5]));
        assert_eq!(b.take(&reading(2, 20, [0.0, 0.5])), Verdict::Refused);
        assert_eq!(b.take(&reading(3, 30, [0.0, 0.5])), Verdict::Refused);
        assert_eq!(b.take(&reading(4, 40, [0.01, 0.5])), Verdict::Jumped(0, -0.99));
        assert_eq!(b.position()[0], 0.01);
        for k in 0..20 {
            let q = if k % 2 == 0 { -1.5 } else { 1.5 };
            assert_eq!(b.take(&reading(5 + k, 50 + 10 * k, [q, 0.5])), Verdict::Refused, "{k}");
        }
    }

    #[test]
    fn the_time_since_the_last_believed_reading_counts() {
        let mut b = belief();
        b.take(&reading(1, 10, [0.0, 0.0]));
        assert_eq!(b.take(&reading(2, 210, [0.55, 0.0])), Verdict::Believed, "0.2 s at 2 rad/s");
        assert_eq!(b.take(&reading(3, 211, [0.59, 0.0])), Verdict::Believed, "at least one period");
    }

    #[test]
    fn without_power_an_arm_may_be_moved_by_hand() {
        let mut b = belief();
        b.take(&ArmState { enabled: false, ..reading(1, 10, [0.0, 0.0]) });
        assert_eq!(b.take(&ArmState { enabled: false, ..reading(2, 20, [1.0, 0.0]) }), Verdict::Believed);
        assert_eq!(b.take(&reading(3, 30, [2.0, 0.0])), Verdict::Believed, "just enabled");
        assert_eq!(b.take(&reading(4, 40, [1.0, 0.0])), Verdict::Refused);
    }

    #[test]
    fn a_joint_of_a_whole_turn_may_pass_pi() {
        let mut b = belief();
        b.take(&reading(1, 10, [0.0, 3.13]));
        assert_eq!(b.take(&reading(2, 20, [0.0, -3.13])), Verdict::Believed);
        assert_eq!(b.take(&reading(3, 30, [0.0, -2.0])), Verdict::Refused);
    }
}
