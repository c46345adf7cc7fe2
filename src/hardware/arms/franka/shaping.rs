//! What the vendor's client does to each command before it is sent: a low-pass filter, then limits of velocity,
//! acceleration and jerk. Both continue from the controller's desired values, so that what it made up for a lost
//! command is no jump.

use super::model::JointRange;
use super::protocol::DOF;
use super::protocol::command::Target;
use super::protocol::state::State;
use crate::joint::braking_speed;

/// Time between two commands [s].
pub const PERIOD: f64 = 0.001;
/// Cutoff frequencies from here on switch the filter off [Hz].
const OFF: f64 = 1000.0;
/// The limits are this much narrower than the controller's.
const MARGIN: f64 = 0.001;
/// Part of the acceleration limit for approaching a target that is far away; the remainder is for the jerk limit.
const BRAKING: f64 = 0.8;
/// Share of the newest velocity in the average of the wanted positions' velocity.
const AVERAGING: f64 = 0.1;
/// Commands in a row whose loss an FER is to survive at constant acceleration.
const LOST: f64 = 3.0;

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
}

impl Shaping {
    /// Creates a filter with a cutoff frequency [Hz], and limits.
    pub fn new(cutoff: f64, limits: Option<[JointRange; DOF]>) -> Self {
        let gain = if cutoff >= OFF { 1.0 } else { PERIOD / (PERIOD + 1.0 / (std::f64::consts::TAU * cutoff)) };
        Self { gain, limits }
    }

    /// Returns the command that answers a state. The first one of a motion is not filtered. `pace`: how fast the wanted
    /// positions move, so that an arm that is far from them brakes in time; without it the vendor's limits alone count,
    /// with which it would swing about them.
    pub fn shape(&self, target: &Target, state: &State, first: bool, pace: Option<&Pace>) -> Target {
        match target {
            Target::Positions(wanted) => Target::Positions(std::array::from_fn(|i| {
                let [q, v, a] = [&state.q_d, &state.dq_d, &state.ddq_d].map(|values| at(values, i));
                let filtered = if first { at(wanted, i) } else { self.filter(at(wanted, i), q) };
                match self.limits.as_ref().and_then(|limits| limits.get(i)) {
                    Some(range) => {
                        let wanted = (filtered - q) / PERIOD;
                        let wanted = pace.map_or(wanted, |pace| braked(range, wanted, pace.nearest(i, wanted)));
                        q + limit(range, q, v, a, wanted) * PERIOD
                    }
                    None => filtered,
                }
            })),
            Target::Velocities(wanted) => Target::Velocities(std::array::from_fn(|i| {
                let [q, v, a] = [&state.q_d, &state.dq_d, &state.ddq_d].map(|values| at(values, i));
                let filtered = self.filter(at(wanted, i), v);
                match self.limits.as_ref().and_then(|limits| limits.get(i)) {
                    Some(range) => limit(range, q, v, a, filtered),
                    None => filtered,
                }
            })),
        }
    }

    fn filter(&self, value: f64, before: f64) -> f64 {
        if self.gain >= 1.0 { value } else { self.gain * value + (1.0 - self.gain) * before }
    }
}

fn at(values: &[f64; DOF], joint: usize) -> f64 {
    values.get(joint).copied().unwrap_or_default()
}

/// Returns the velocity at which the joint can still brake to that of its target. `wanted` leads there in one period,
/// and is kept if the acceleration for that is no more than an ordinary one.
fn braked(range: &JointRange, wanted: f64, pace: f64) -> f64 {
    let (excess, acceleration) = (wanted - pace, BRAKING * range.acceleration);
    if excess.abs() <= acceleration * PERIOD {
        return wanted;
    }
    pace + excess.signum() * braking_speed(excess.abs() * PERIOD, acceleration, PERIOD)
}

/// Returns the velocity closest to `wanted` that the limits allow after velocity `v` and acceleration `a` at position
/// `q`. Near the top speed the acceleration falls, so that the jerk stays within its limit there.
fn limit(range: &JointRange, q: f64, v: f64, a: f64, wanted: f64) -> f64 {
    let (low, high) = range.velocities(q);
    let reserve = if range.braking.is_none() { LOST * PERIOD * range.acceleration } else { 0.0 };
    let (low, high) = (low + MARGIN + reserve, high - MARGIN - reserve);
    let (most, jerk) = (range.acceleration - MARGIN, range.jerk - MARGIN);
    let change = (((wanted - v) / PERIOD - a) / PERIOD).clamp(-jerk, jerk);
    let slope = jerk / most;
    let highest = (slope * (high - v)).min(most);
    let lowest = (slope * (low - v)).max(-most);
    v + (a + change * PERIOD).min(highest).max(lowest) * PERIOD
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hardware::arms::franka::model::Model;

    /// Answers states as a controller that takes every command would send them.
    fn run(
        model: Model,
        shaping: &Shaping,
        velocity: bool,
        wanted: impl Fn(usize) -> [f64; DOF],
        steps: usize,
    ) -> State {
        let mut state = State { q_d: [0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0], ..State::default() };
        for i in 0..steps {
            let target = if velocity { Target::Velocities(wanted(i)) } else { Target::Positions(wanted(i)) };
            let before = state;
            state.dq_d = match shaping.shape(&target, &state, i == 0, None) {
                Target::Positions(q) => std::array::from_fn(|j| (q[j] - before.q_d[j]) / PERIOD),
                Target::Velocities(v) => v,
            };
            for (j, range) in model.ranges().iter().enumerate() {
                state.q_d[j] += state.dq_d[j] * PERIOD;
                state.ddq_d[j] = (state.dq_d[j] - before.dq_d[j]) / PERIOD;
                let jerk = (state.ddq_d[j] - before.ddq_d[j]) / PERIOD;
                let (low, high) = range.velocities(before.q_d[j]);
                assert!((low..=high).contains(&state.dq_d[j]), "step {i}: {} rad/s", state.dq_d[j]);
                assert!(state.ddq_d[j].abs() < range.acceleration, "step {i}: {} rad/s²", state.ddq_d[j]);
                assert!(jerk.abs() < range.jerk, "step {i}: {jerk} rad/s³");
            }
        }
        state
    }

    #[test]
    fn the_gain_is_the_vendors() {
        assert!((Shaping::new(100.0, None).gain - 0.3859).abs() < 1e-4);
        assert_eq!(Shaping::new(1000.0, None).gain, 1.0);
    }

    #[test]
    fn any_target_stays_within_the_limits() {
        for model in [Model::Fer, Model::Fr3] {
            let shaping = Shaping::new(100.0, Some(model.ranges()));
            // Where the speed limit falls with the position, the vendor's limiter is over by some percent: not here.
            let state = run(model, &shaping, false, |_| [2.5, 1.0, -2.0, -2.5, 2.0, 3.0, -2.0], 150);
            assert!(state.dq_d[0] > 1.0, "{state:?}");
            let state = run(model, &shaping, true, |i| [if i < 150 { 9.0 } else { -9.0 }; DOF], 300);
            assert!(state.dq_d[4] < 1.0, "{state:?}");
        }
    }

    /// With the vendor's limits alone it would swing about a position that is far away for ever.
    #[test]
    fn a_position_far_away_is_reached_without_swinging() {
        let shaping = Shaping::new(100.0, Some(Model::Fr3.ranges()));
        let target = [0.4, -0.2, 0.05, -1.9, 0.01, 1.2, 0.3];
        let mut state = State { q_d: [0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0], ..State::default() };
        let (mut pace, mut farthest) = (Pace::default(), 0.0_f64);
        for i in 0..700 {
            pace.take(&target, 1);
            let before = state;
            let Target::Positions(q) = shaping.shape(&Target::Positions(target), &state, i == 0, Some(&pace)) else {
                unreachable!()
            };
            state.q_d = q;
            state.dq_d = std::array::from_fn(|j| (q[j] - before.q_d[j]) / PERIOD);
            state.ddq_d = std::array::from_fn(|j| (state.dq_d[j] - before.dq_d[j]) / PERIOD);
            farthest = farthest.max(q[0] - target[0]);
        }
        assert!(farthest < 2e-3, "{farthest} rad beyond");
        assert!(state.q_d.iter().zip(&target).all(|(q, target)| (q - target).abs() < 1e-4), "{state:?}");
        assert!(state.dq_d.iter().all(|v| v.abs() < 1e-3), "{state:?}");
    }

    #[test]
    fn a_velocity_is_reached_and_kept() {
        let shaping = Shaping::new(100.0, Some(Model::Fr3.ranges()));
        let state = run(Model::Fr3, &shaping, true, |_| [0.5; DOF], 200);
        assert!(state.dq_d.iter().all(|v| (v - 0.5).abs() < 1e-6), "{state:?}");
    }
}
