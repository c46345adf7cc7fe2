//! From the setpoints of the tick to one value for each state.
//!
//! A run whose tick follows this arm's clock writes one setpoint right after each state: it is the answer. Any other
//! rate or phase is smoothed: then every state is answered when it is read, with an average of the newest setpoints.

use std::time::Duration;

use super::protocol::DOF;
use super::protocol::state::State;
use super::shaping::PERIOD;
use super::smoothing::{Fade, Smoothing};

/// A setpoint that comes later than this after its state may reach the controller too late.
const IN_TIME: Duration = Duration::from_micros(600);
/// Consecutive setpoints in time after which they are the answers.
const IN_STEP: u32 = 50;
/// States without a setpoint count this much, those with one count back by one. From the sum on, states are answered
/// without one: 20 in a row without an answer would end the motion.
const UNANSWERED: u32 = 4;
const OUT_OF_STEP: u32 = 32;
/// Setpoints that are missing for longer have ended [states]; up to here they only come irregularly.
const PAUSE: u64 = 5;
/// A smaller jump is none: a filtered one causes less than the acceleration limit [rad].
const JUMP: f64 = 2e-5;
/// Joints whose desired speed is lower are at rest [rad/s].
const REST: f64 = 1e-4;
/// A stream of velocities that ends is a hold after this time [states].
const VELOCITY_ENDS: u64 = 100;
/// States that were missed at once are made up for, up to this number.
const MAX_MISSED: u64 = 40;

/// Setpoints of a motion.
#[derive(Debug, Clone)]
pub struct Follower {
    velocity: bool,
    /// The newest setpoint [rad or rad/s], whether it is still to be sent, and the state that was the newest when it
    /// came.
    goal: [f64; DOF],
    waiting: bool,
    goal_at: u64,
    any: bool,
    /// States between the last two setpoints.
    interval: u64,
    smoothing: Smoothing,
    fade: Fade,
    /// Whether setpoints are answers.
    direct: bool,
    in_step: u32,
    unanswered: u32,
    /// A setpoint or an answer was lost: the next one is made to continue from where the arm is.
    slipped: bool,
    /// The newest state, and the one that was answered last.
    newest: u64,
    answered: u64,
    /// Gain of the filter that comes after this.
    gain: f64,
}

impl Follower {
    /// Begins a motion at rest where the arm is to be.
    pub fn new(state: &State, velocity: bool, gain: f64) -> Self {
        let goal = if velocity { [0.0; DOF] } else { state.q_d };
        Self {
            velocity,
            goal,
            waiting: false,
            goal_at: state.id,
            any: false,
            interval: 1,
            smoothing: Smoothing::new(&goal),
            fade: Fade::default(),
            direct: false,
            in_step: 0,
            unanswered: 0,
            slipped: false,
            newest: state.id,
            answered: state.id,
            gain,
        }
    }

    #[cfg(test)]
    /// Returns whether setpoints are sent as answers when they come.
    pub fn is_direct(&self) -> bool {
        self.direct
    }

    /// Takes a setpoint that comes `age` after the newest state. Returns the answer to that state, if it is one.
    pub fn setpoint(&mut self, goal: &[f64; DOF], state: &State, age: Duration) -> Option<[f64; DOF]> {
        let interval = state.id.saturating_sub(self.goal_at);
        let in_time = age < IN_TIME;
        self.in_step = if interval == 1 && in_time { self.in_step + 1 } else { 0 };
        self.slipped |= self.direct && interval != 1;
        self.goal_at = state.id;
        let before = std::mem::replace(&mut self.interval, interval);
        if self.any {
            // A pause is no interval.
            self.smoothing.fit(interval.min(before).max(1), &self.goal);
        } else if !self.velocity {
            // The first setpoint may be the measured position, which is not quite the desired one.
            self.smoothing.restart(goal);
            self.slipped = true;
        }
        (self.goal, self.waiting, self.any) = (*goal, true, true);
        (self.direct && in_time && self.answered != state.id).then(|| self.answer(state))
    }

    /// Takes a state. Returns the answer, unless the setpoint that is to come is the answer.
    pub fn state(&mut self, state: &State) -> Option<[f64; DOF]> {
        let missed = state.id.saturating_sub(self.newest).clamp(1, MAX_MISSED);
        let skipped = self.newest != self.answered || missed > 1;
        self.newest = state.id;
        if self.velocity && state.id.saturating_sub(self.goal_at) > VELOCITY_ENDS {
            self.goal = [0.0; DOF];
        }
        if self.direct {
            self.slipped |= skipped;
            self.unanswered = match skipped {
                true => self.unanswered + UNANSWERED,
                false => self.unanswered.saturating_sub(1),
            };
            if self.unanswered < OUT_OF_STEP {
                return if self.waiting { Some(self.answer(state)) } else { None };
            }
            (self.direct, self.in_step, self.slipped) = (false, 0, true);
            // At rest nothing ends abruptly: the next motion is not to lag by the longest averages.
            if state.dq_d.iter().all(|v| v.abs() < REST) {
                self.smoothing = Smoothing::new(&self.goal);
                return Some(self.answer(state));
            }
            let change = if self.velocity { [0.0; DOF] } else { state.dq_d.map(|v| v * PERIOD) };
            self.smoothing.restart_moving(&self.goal, &change, state.id.saturating_sub(self.goal_at) > PAUSE);
        } else if self.in_step >= IN_STEP && self.smoothing.rests_at(&self.goal) {
            (self.direct, self.unanswered) = (true, 0);
        }
        // What was not answered in between passed for the setpoints, too.
        for _ in 1..missed {
            self.smoothing.push(&self.goal);
        }
        Some(self.answer(state))
    }

    fn answer(&mut self, state: &State) -> [f64; DOF] {
        let smooth = self.smoothing.push(&self.goal);
        let base = if self.direct { self.goal } else { smooth };
        (self.waiting, self.answered) = (false, state.id);
        if self.velocity {
            return base;
        }
        self.fade.pass();
        if std::mem::take(&mut self.slipped) {
            // Where the filter and a constant velocity would have it.
            let offset = self.fade.value();
            let jump = std::array::from_fn(|i| {
                let [q, v, base, offset] = [&state.q_d, &state.dq_d, &base, &offset].map(|values| at(values, i));
                q + v * PERIOD / self.gain - base - offset
            });
            if jump.iter().any(|jump: &f64| jump.abs() > JUMP) {
                self.fade.add(&jump);
                // Setpoints that slip repeatedly are at another rate.
                self.unanswered += if self.direct { UNANSWERED } else { 0 };
            }
        }
        let offset = self.fade.value();
        std::array::from_fn(|i| at(&base, i) + at(&offset, i))
    }
}

fn at(values: &[f64; DOF], joint: usize) -> f64 {
    values.get(joint).copied().unwrap_or_default()
}

#[cfg(test)]
#[path = "follower_tests.rs"]
mod tests;
