//! What is done to each command before it is sent: the low-pass filter of the vendor's client, then limits of velocity,
//! acceleration and jerk, 3 % inside the published ones. Both continue from the controller's desired values, so that
//! what it made up for a lost command is no jump.

use super::ceiling::{SHARE, UserLimit, accelerations};
use super::model::JointRange;
use super::protocol::DOF;
use super::protocol::command::Target;
use super::protocol::state::State;
use dimos_core::joint::braking_speed;

/// Time between two commands [s].
pub const PERIOD: f64 = 0.001;
/// Cutoff frequencies from here on switch the filter off [Hz].
const OFF: f64 = 1000.0;
/// Share of the jerk limit while the desired positions are known to 32 bits only.
const ROUNDED: f64 = 0.85;
/// Part of the acceleration that the setpoints leave with which a joint approaches a target that is far away; the
/// remainder is for the jerk limit. Setpoints may brake at the limit of the user themselves.
const BRAKING: f64 = 0.8;
/// Most of it, as a multiple of the limit of the user.
const CATCHING_UP: f64 = 0.5;
/// Acceleration limit of setpoints where the user has none, as a share of the published one.
const SETPOINTS: f64 = 0.7;
/// Share of the newest velocity in the average of the wanted positions' velocity.
const AVERAGING: f64 = 0.1;

/// How fast wanted positions move.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Pace {
    before: Option<[f64; DOF]>,
    /// Velocities from the last position to this one, and their moving average [rad/s].
    now: [f64; DOF],
    average: [f64; DOF],
}

impl Pace {
    /// Takes the wanted positions [rad] of a state, `periods` after the last ones.
    pub fn take(&mut self, wanted: &[f64; DOF], periods: u64) {
        let before = self.before.replace(*wanted).unwrap_or(*wanted);
        let time = periods.max(1) as f64 * PERIOD;
        self.now = std::array::from_fn(|i| (at(wanted, i) - at(&before, i)) / time);
        self.average =
            std::array::from_fn(|i| at(&self.average, i) + AVERAGING * (at(&self.now, i) - at(&self.average, i)));
    }

    /// Returns the velocity of a joint's wanted positions [rad/s] that agrees best with `wanted`: the average where
    /// they come irregularly.
    fn nearest(&self, joint: usize, wanted: f64) -> f64 {
        let (now, average) = (at(&self.now, joint), at(&self.average, joint));
        if (wanted - now).abs() <= (wanted - average).abs() { now } else { average }
    }
}

/// Filter and limits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shaping {
    /// Share of the new value in the filter's output, 0 to 1.
    pub gain: f64,
    /// The limits; `None`: none.
    pub limits: Option<[JointRange; DOF]>,
    /// Limits of the user, which are no wider.
    pub user: [UserLimit; DOF],
    /// Whether the desired positions are rounded: then jerks leave room for that.
    pub rounded: bool,
}

impl Shaping {
    /// Creates a filter with a cutoff frequency [Hz], and limits.
    pub fn new(cutoff: f64, limits: Option<[JointRange; DOF]>) -> Self {
        let gain = if cutoff >= OFF { 1.0 } else { PERIOD / (PERIOD + 1.0 / (std::f64::consts::TAU * cutoff)) };
        Self { gain, limits, user: [UserLimit::NONE; DOF], rounded: false }
    }

    /// Returns the command that answers a state. The first one of a motion is not filtered. `pace`: how fast the wanted
    /// positions move, so that an arm that is far from them brakes in time; without it the vendor's limits alone count,
    /// with which it would swing about them.
    pub fn shape(&self, target: &Target, state: &State, first: bool, pace: Option<&Pace>) -> Target {
        match target {
            Target::Positions(wanted) => Target::Positions(std::array::from_fn(|i| {
                let q = at(&state.q_d, i);
                let filtered = if first { at(wanted, i) } else { self.filter(at(wanted, i), q) };
                match self.limits.as_ref().and_then(|limits| limits.get(i)) {
                    Some(range) => {
                        let wanted = (filtered - q) / PERIOD;
                        let most = self.user.get(i).map_or(f64::INFINITY, |user| user.acceleration);
                        let wanted = pace.map_or(wanted, |pace| braked(range, most, wanted, pace.nearest(i, wanted)));
                        q + self.limit(i, range, state, wanted) * PERIOD
                    }
                    None => filtered,
                }
            })),
            Target::Velocities(wanted) => Target::Velocities(std::array::from_fn(|i| {
                let filtered = self.filter(at(wanted, i), at(&state.dq_d, i));
                match self.limits.as_ref().and_then(|limits| limits.get(i)) {
                    Some(range) => self.limit(i, range, state, filtered),
                    None => filtered,
                }
            })),
        }
    }

    /// Returns the velocity closest to `wanted` that the limits allow a joint. Acceleration and jerk count more than
    /// velocity: what the controller made up for lost commands may have to be braked.
    fn limit(&self, joint: usize, range: &JointRange, state: &State, wanted: f64) -> f64 {
        let [q, v, a] = [&state.q_d, &state.dq_d, &state.ddq_d].map(|values| at(values, joint));
        let user = self.user.get(joint).unwrap_or(&UserLimit::NONE);
        let (low, high) = accelerations(range, user, q, v);
        let step = if self.rounded { ROUNDED } else { SHARE } * range.jerk * PERIOD;
        let most = SHARE * range.acceleration;
        let allowed = ((wanted - v) / PERIOD).min(high).max(low);
        v + allowed.clamp(a - step, a + step).clamp(-most, most) * PERIOD
    }

    fn filter(&self, value: f64, before: f64) -> f64 {
        if self.gain >= 1.0 { value } else { self.gain * value + (1.0 - self.gain) * before }
    }
}

fn at(values: &[f64; DOF], joint: usize) -> f64 {
    values.get(joint).copied().unwrap_or_default()
}

/// Returns the velocity at which the joint can still brake to that of its target. `wanted` leads there in one period,
/// and is kept if the acceleration for that is no more than an ordinary one. `most`: acceleration limit of the user.
fn braked(range: &JointRange, most: f64, wanted: f64, pace: f64) -> f64 {
    let setpoints = most.min(SETPOINTS * range.acceleration);
    let left = BRAKING * (SHARE * range.acceleration - setpoints);
    let (excess, acceleration) = (wanted - pace, left.min(CATCHING_UP * setpoints));
    if excess.abs() <= acceleration * PERIOD {
        return wanted;
    }
    pace + excess.signum() * braking_speed(excess.abs() * PERIOD, acceleration, PERIOD)
}

#[cfg(test)]
#[path = "shaping_tests.rs"]
mod tests;
