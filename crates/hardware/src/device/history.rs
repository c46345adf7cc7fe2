//! Joint positions of the last two seconds by time, interpolated: for what comes late, such as a picture.

use std::collections::VecDeque;
use std::sync::Mutex;
use std::time::Duration;

use dimos_core::arm::{ArmState, VelocitySource};
use dimos_core::clock::Mono;
use dimos_core::joint::{Joints, MAX_DOF};
use dimos_core::sync::lock;

/// How far back it goes.
const SPAN: Duration = Duration::from_secs(2);
/// Nothing is known between two states that are further apart.
const LONGEST_GAP: Duration = Duration::from_millis(250);
/// The most states that are kept: 2 s at 1 kHz.
const MOST: usize = 2048;

/// A measured state.
#[derive(Debug, Clone, Copy)]
struct Moment {
    stamp: Mono,
    position: Joints,
    /// Where they are measured.
    velocity: Option<Joints>,
}

/// The latest states of an arm.
#[derive(Debug)]
pub struct History(Mutex<VecDeque<Moment>>);

impl Default for History {
    /// Allocates all memory that it will need.
    fn default() -> Self {
        Self(Mutex::new(VecDeque::with_capacity(MOST)))
    }
}

impl History {
    /// Takes a state. While another thread reads, the state is left out: the device thread does not wait.
    pub fn take(&self, state: &ArmState) {
        let Ok(mut moments) = self.0.try_lock() else { return };
        let old = |moment: &Moment| state.stamp.since(moment.stamp) > SPAN;
        while moments.len() >= MOST || moments.front().is_some_and(old) {
            moments.pop_front();
        }
        if moments.back().is_none_or(|newest| newest.stamp < state.stamp) {
            let velocity = (state.velocity_source == VelocitySource::Measured).then_some(state.velocity);
            moments.push_back(Moment { stamp: state.stamp, position: state.position, velocity });
        }
    }

    /// Returns the positions at a time [rad or m]; `None`: before the oldest state, after the newest, or in a gap. It
    /// never extrapolates.
    pub fn at(&self, time: Mono) -> Option<Joints> {
        let moments = lock(&self.0);
        let after = moments.partition_point(|moment| moment.stamp < time);
        let later = moments.get(after)?;
        if later.stamp == time {
            return Some(later.position);
        }
        let earlier = moments.get(after.checked_sub(1)?)?;
        if later.stamp.since(earlier.stamp) > LONGEST_GAP {
            return None;
        }
        Some(between(earlier, later, time))
    }
}

/// Returns the positions between two states: a cubic with their velocities, or a line.
fn between(a: &Moment, b: &Moment, time: Mono) -> Joints {
    let span = b.stamp.seconds_since(a.stamp);
    let s = time.seconds_since(a.stamp) / span;
    let mut out = [0.0; MAX_DOF];
    for (j, (out, (from, to))) in out.iter_mut().zip(a.position.iter().zip(&b.position)).enumerate() {
        let of = |velocity: &Option<Joints>| velocity.as_ref().and_then(|list| list.get(j)).copied();
        *out = match of(&a.velocity).zip(of(&b.velocity)) {
            Some((v0, v1)) => {
                let (d, m0, m1) = (to - from, v0 * span, v1 * span);
                from + s * (m0 + s * (3.0 * d - 2.0 * m0 - m1 + s * (m0 + m1 - 2.0 * d)))
            }
            None => from + (to - from) * s,
        };
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_core::joint::joints_of;

    fn ms(t: u64) -> Mono {
        Mono(1_000_000_000 + t * 1_000_000)
    }

    fn state(t: u64, velocity_source: VelocitySource) -> ArmState {
        let time = t as f64 * 1e-3;
        let (position, velocity) = (joints_of(&[time.sin()]), joints_of(&[time.cos()]));
        ArmState { stamp: ms(t), position, velocity, velocity_source, ..ArmState::default() }
    }

    #[test]
    fn positions_of_two_seconds_are_known_between_the_states_too_and_never_beyond_them() {
        for (source, exact) in [(VelocitySource::Measured, 1e-8), (VelocitySource::Absent, 4e-4)] {
            let history = History::default();
            (0..100).for_each(|k| history.take(&state(k * 50, source)));
            for t in [4949, 3333, 2951] {
                let q = history.at(ms(t)).unwrap()[0];
                assert!((q - (t as f64 * 1e-3).sin()).abs() < exact, "{t}: {q}");
            }
            assert_eq!((history.at(ms(4951)), history.at(ms(2900))), (None, None), "what is older is gone");
            assert_eq!(history.at(ms(4950)), Some(state(4950, source).position));
        }
    }

    #[test]
    fn nothing_is_made_up_in_a_gap_and_a_state_that_comes_twice_counts_once() {
        let history = History::default();
        [0, 100, 100, 500, 600].into_iter().for_each(|t| history.take(&state(t, VelocitySource::Absent)));
        assert!(history.at(ms(50)).is_some() && history.at(ms(300)).is_none() && history.at(ms(550)).is_some());
        assert_eq!(lock(&history.0).len(), 4);
    }
}
