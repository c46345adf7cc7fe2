//! What the controller makes of a command, or of none: desired values, judged by backward differences. Nothing is
//! clamped or smoothed. Its history is in full precision: a state rounds it, the judgement does not.

use super::control::{CYCLE, Command, Control, DOF, IDLE, REFLEX};
use super::wire::Ended;

/// The errors that a motion can cause, as numbers of their flags.
pub(super) const START_POSE: u32 = 11;
pub(super) const POSITION: u32 = 12;
pub(super) const VELOCITY: u32 = 13;
pub(super) const ACCELERATION: u32 = 14;
pub(super) const JERK: u32 = 15;
pub(super) const COMMUNICATION: u32 = 25;

/// How far the first position may be from the desired one [rad]. The vendor publishes no figure.
const START: f64 = 1e-3;
/// A motion that is finished faster than this has a jump in its velocity [rad/s]. The vendor publishes no figure.
const FINISHED: f64 = 0.02;
/// Number of cycles of the success rate.
const HISTORY: usize = 100;
/// Commands lost in a row that end a motion.
const MOST_LOST: u32 = 20;

impl Control {
    /// Steps the desired values.
    pub(super) fn step_motion(&mut self) {
        let command = self.command.take();
        if self.motion.is_none() {
            return self.brake();
        }
        self.count(command.is_some());
        if self.lost_in_row >= MOST_LOST {
            return self.fail(COMMUNICATION);
        }
        let error = match command {
            Some(command) => self.follow(&command),
            None => {
                // Constant acceleration.
                let velocities = std::array::from_fn(|i| at(&self.dq_d, i) + at(&self.ddq_d, i) * CYCLE);
                self.judge(&velocities)
            }
        };
        if let Some(error) = error {
            self.fail(error);
        }
    }

    fn count(&mut self, came: bool) {
        self.figures.moved += 1;
        self.lost_in_row = if came { 0 } else { self.lost_in_row + 1 };
        self.figures.lost += u64::from(!came);
        self.figures.longest_loss = self.figures.longest_loss.max(self.lost_in_row);
        self.history.push_back(came);
        if self.history.len() > HISTORY {
            self.history.pop_front();
        }
    }

    /// Share of the last commands that came in time.
    pub(super) fn success_rate(&self) -> f64 {
        let came = self.history.iter().filter(|came| **came).count();
        if self.motion.is_none() || self.history.is_empty() { 0.0 } else { came as f64 / self.history.len() as f64 }
    }

    /// Takes a command. Returns the error that it causes.
    fn follow(&mut self, command: &Command) -> Option<u32> {
        let first = self.motion.as_mut().is_some_and(|motion| !std::mem::replace(&mut motion.begun, true));
        let velocities = match self.generator {
            2 => command.velocities,
            _ => {
                let jump = |(a, b): (&f64, &f64)| (a - b).abs() > START;
                if first && command.positions.iter().zip(&self.q_d).any(jump) {
                    return Some(START_POSE);
                }
                std::array::from_fn(|i| (at(&command.positions, i) - at(&self.q_d, i)) / CYCLE)
            }
        };
        let error = self.judge(&velocities);
        if error.is_none() && command.finished {
            if self.dq_d.iter().any(|v| v.abs() > FINISHED) {
                return Some(ACCELERATION);
            }
            (self.dq_d, self.ddq_d) = ([0.0; DOF], [0.0; DOF]);
            self.end_motion(Ended::Success);
            self.show_rest(IDLE);
        }
        error
    }

    /// Makes velocities the desired ones. Returns the limit that they break.
    fn judge(&mut self, velocities: &[f64; DOF]) -> Option<u32> {
        let mut error = None;
        for i in 0..DOF {
            let (Some(range), v) = (self.ranges.get(i), at(velocities, i)) else { continue };
            let (q, v_before, a_before) = (at(&self.q_d, i), at(&self.dq_d, i), at(&self.ddq_d, i));
            let next = q + v * CYCLE;
            let a = (v - v_before) / CYCLE;
            let (low, high) = range.velocities(q);
            let found = if !v.is_finite() || next < range.lower || next > range.upper {
                Some(POSITION)
            } else if v < low || v > high {
                Some(VELOCITY)
            } else if a.abs() > range.acceleration {
                Some(ACCELERATION)
            } else if ((a - a_before) / CYCLE).abs() > range.jerk {
                Some(JERK)
            } else {
                None
            };
            error = error.or(found);
        }
        if error.is_some() {
            return error;
        }
        let before = self.dq_d;
        self.q_d = std::array::from_fn(|i| at(&self.q_d, i) + at(velocities, i) * CYCLE);
        self.dq_d = *velocities;
        self.ddq_d = std::array::from_fn(|i| (at(velocities, i) - at(&before, i)) / CYCLE);
        None
    }

    /// Decelerates to rest, as the controller itself does after a stop or an error.
    fn brake(&mut self) {
        if !self.braking {
            return;
        }
        let before = self.dq_d;
        for (v, range) in self.dq_d.iter_mut().zip(&self.ranges) {
            let step = range.acceleration * CYCLE;
            *v -= v.clamp(-step, step);
        }
        self.ddq_d = std::array::from_fn(|i| (at(&self.dq_d, i) - at(&before, i)) / CYCLE);
        self.q_d = std::array::from_fn(|i| at(&self.q_d, i) + at(&self.dq_d, i) * CYCLE);
        if self.dq_d == [0.0; DOF] {
            (self.braking, self.ddq_d) = (false, [0.0; DOF]);
            if self.mode == super::control::MOVE {
                self.show_rest(IDLE);
            }
            if let Some((who, id)) = self.stopping.take() {
                self.answer(who, super::wire::STOP, id, 0);
            }
        }
    }

    /// Stops the arm with an error.
    pub(super) fn fail(&mut self, bit: u32) {
        self.errors |= 1 << bit;
        self.reason = self.errors;
        self.end_motion(Ended::Reflex);
        self.show_rest(REFLEX);
        self.braking = true;
    }

    /// Ends the motion, and answers its Move.
    pub(super) fn end_motion(&mut self, how: Ended) {
        if let Some(motion) = self.motion.take() {
            let status = how.status(self.wide());
            self.answer(motion.owner, super::wire::MOVE, motion.id, status);
        }
    }
}

fn at(values: &[f64; DOF], joint: usize) -> f64 {
    values.get(joint).copied().unwrap_or_default()
}
