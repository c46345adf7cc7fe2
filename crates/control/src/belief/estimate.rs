//! Estimates joint velocities of an arm that reports none: finite differences of its positions, low-pass filtered.

use dimos_core::arm::{ArmState, VelocitySource};
use dimos_core::clock::Mono;
use dimos_core::joint::{Joints, MAX_DOF};

/// Time constant of the filter [s].
const TIME_CONSTANT: f64 = 0.02;
/// After a longer gap between two states the estimate restarts at 0 [s].
const LONGEST_GAP: f64 = 0.1;

/// Estimates one arm's joint velocities.
#[derive(Debug, Clone, Copy)]
pub struct VelocityEstimator {
    seq: u64,
    stamp: Mono,
    position: Joints,
    velocity: Joints,
}

impl Default for VelocityEstimator {
    fn default() -> Self {
        Self { seq: 0, stamp: Mono::ZERO, position: [0.0; MAX_DOF], velocity: [0.0; MAX_DOF] }
    }
}

impl VelocityEstimator {
    /// Fills in the velocities of a state that has none, and marks them.
    pub fn fill(&mut self, state: &mut ArmState) {
        if state.seq == 0 || state.velocity_source == VelocitySource::Measured {
            return;
        }
        if state.seq != self.seq {
            let gap = state.stamp.seconds_since(self.stamp);
            if self.seq == 0 || !(0.0..=LONGEST_GAP).contains(&gap) {
                self.velocity = [0.0; MAX_DOF];
            } else if gap > 0.0 {
                let weight = gap / (TIME_CONSTANT + gap);
                for (v, (new, old)) in self.velocity.iter_mut().zip(state.position.iter().zip(&self.position)) {
                    *v += weight * ((new - old) / gap - *v);
                }
            }
            self.seq = state.seq;
            self.stamp = state.stamp;
            self.position = state.position;
        }
        state.velocity = self.velocity;
        state.velocity_source = VelocitySource::Estimated;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state(seq: u64, ms: u64, q: f64) -> ArmState {
        let mut s = ArmState { seq, stamp: Mono(ms * 1_000_000), dof: 1, ..ArmState::default() };
        s.position[0] = q;
        s
    }

    #[test]
    fn a_ramp_is_estimated_at_its_slope_and_marked() {
        let mut e = VelocityEstimator::default();
        let mut last = ArmState::default();
        for k in 1..=50 {
            last = state(k, k * 10, 0.5 * 0.01 * k as f64);
            e.fill(&mut last);
        }
        assert!((last.velocity[0] - 0.5).abs() < 1e-3, "{}", last.velocity[0]);
        assert_eq!(last.velocity_source, VelocitySource::Estimated);
    }

    #[test]
    fn the_same_state_read_twice_changes_nothing_and_a_gap_restarts_the_estimate() {
        let mut e = VelocityEstimator::default();
        e.fill(&mut state(1, 10, 0.0));
        let (mut a, mut b) = (state(2, 20, 0.01), state(2, 20, 0.01));
        e.fill(&mut a);
        e.fill(&mut b);
        assert_eq!(a, b);
        let mut late = state(3, 500, 0.4);
        e.fill(&mut late);
        assert_eq!(late.velocity[0], 0.0);
    }

    #[test]
    fn measured_velocities_stay() {
        let mut s = state(1, 10, 0.0);
        s.velocity[0] = 7.0;
        s.velocity_source = VelocitySource::Measured;
        VelocityEstimator::default().fill(&mut s);
        assert_eq!((s.velocity[0], s.velocity_source), (7.0, VelocitySource::Measured));
    }
}
