//! Whether an arm rests, by its positions and its velocities: a velocity of zero alone is no evidence.

use std::time::Duration;

use dimos_core::arm::{ArmState, VelocitySource};
use dimos_core::clock::Mono;
use dimos_core::joint::{Joints, MAX_DOF, TICK_STANDSTILL};

/// Bounds of the distance that a joint at rest may be read from where it rests [rad]: noise, not motion.
const NOISE: (f64, f64) = (0.005, 0.01);

/// Since when the readings of an arm agree with each other.
#[derive(Debug, Clone)]
pub struct Stillness {
    dof: usize,
    noise: f64,
    anchor: Joints,
    since: Option<Mono>,
    newest: Mono,
}

impl Stillness {
    /// Creates it for an arm with this accuracy [rad].
    pub fn new(dof: usize, accuracy: f64) -> Self {
        let noise = accuracy.clamp(NOISE.0, NOISE.1);
        Self { dof: dof.min(MAX_DOF), noise, anchor: [0.0; MAX_DOF], since: None, newest: Mono::ZERO }
    }

    /// Starts over: a reading was not accepted, or the arm is another one.
    pub fn reset(&mut self) {
        self.since = None;
    }

    /// Takes an accepted state.
    pub fn take(&mut self, state: &ArmState) {
        // An estimate has nothing that the positions have not.
        let measured = state.velocity_source == VelocitySource::Measured;
        let slow = !measured || state.velocity.iter().take(self.dof).all(|v| v.abs() <= TICK_STANDSTILL);
        let mut moved = state.position.iter().zip(&self.anchor).take(self.dof);
        let near = moved.all(|(q, anchor)| (q - anchor).abs() <= self.noise);
        if self.since.is_none() || !near || !slow {
            (self.anchor, self.since) = (state.position, slow.then_some(state.stamp));
        }
        self.newest = state.stamp;
    }

    /// Returns how long all joints have been at rest, by the time stamps of their readings.
    pub fn time(&self) -> Duration {
        self.since.map_or(Duration::ZERO, |since| self.newest.since(since))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_core::joint::joints_of;

    fn state(ms: u64, q: f64, v: f64) -> ArmState {
        let (position, velocity) = (joints_of(&[q]), joints_of(&[v]));
        let velocity_source = VelocitySource::Measured;
        let stamp = Mono(ms * 1_000_000);
        ArmState { seq: ms, stamp, dof: 1, position, velocity, velocity_source, ..ArmState::default() }
    }

    #[test]
    fn an_arm_rests_while_neither_its_positions_nor_its_velocities_move() {
        let mut still = Stillness::new(1, 0.002);
        (10..=100).step_by(10).for_each(|ms| still.take(&state(ms, 0.5 + 0.001 * (ms % 20) as f64 / 10.0, 0.0)));
        assert_eq!(still.time(), Duration::from_millis(90));
        still.take(&state(110, 0.5, 0.2));
        assert_eq!(still.time(), Duration::ZERO, "a velocity");
        still.take(&state(120, 0.5, 0.0));
        still.take(&state(130, 0.5, 0.0));
        assert_eq!(still.time(), Duration::from_millis(10));
    }

    #[test]
    fn a_joint_that_creeps_with_a_velocity_of_zero_does_not_rest() {
        let mut still = Stillness::new(1, 0.002);
        for ms in (10..=1000).step_by(10) {
            still.take(&state(ms, 0.3 * ms as f64 * 1e-3, 0.0));
            assert!(still.time() < Duration::from_millis(20), "{ms}");
        }
    }
}
