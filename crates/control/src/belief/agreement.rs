//! Whether an arm's positions and velocities tell of the same motion. An encoder that hangs shows a velocity without a
//! change of position; one that slips, a change without a velocity.

use dimos_core::arm::{ArmState, VelocitySource};
use dimos_core::joint::{Joints, MAX_DOF, joints_of};

/// Time constant with which old differences are forgotten [s].
const MEMORY: f64 = 0.5;
/// Difference that noise and filters cause [rad], and the lag of a velocity's filter: it causes this many seconds of
/// the highest recent velocity.
const TOLERANCE: f64 = 0.06;
const FILTER_LAG: f64 = 0.12;
/// After a longer time between two readings the comparison starts over [s].
const LONGEST_GAP: f64 = 0.1;

/// Integrated difference of positions and velocities of one arm.
#[derive(Debug, Clone)]
pub struct Agreement {
    dof: usize,
    /// A faster velocity is no velocity of the joint [rad/s].
    fastest: Joints,
    /// Whether the arm ever reported a velocity other than zero: until then, zeros are what adapters without velocities
    /// fill in, and no evidence.
    has_velocity: bool,
    before: Option<ArmState>,
    difference: Joints,
    /// Highest recent speed of each joint [rad/s].
    speed: Joints,
}

impl Agreement {
    /// Creates it for an arm without readings so far, whose joints have these top speeds [rad/s].
    pub fn new(top_speeds: &[f64]) -> Self {
        let (difference, speed) = ([0.0; MAX_DOF], [0.0; MAX_DOF]);
        let fastest = joints_of(top_speeds).map(|top| 2.0 * top);
        Self { dof: top_speeds.len().min(MAX_DOF), fastest, has_velocity: false, before: None, difference, speed }
    }

    /// Starts over, without forgetting whether the arm has velocities.
    pub fn reset(&mut self) {
        (self.before, self.difference, self.speed) = (None, [0.0; MAX_DOF], [0.0; MAX_DOF]);
    }

    /// Returns whether the state's velocities are measured ones.
    pub fn has_velocity(&self, state: &ArmState) -> bool {
        self.has_velocity && state.velocity_source == VelocitySource::Measured
    }

    /// Takes an accepted reading of a new state with the arm's own velocities. Returns the joint whose position and
    /// velocity contradict each other the most, and by how much [rad], if that is more than noise.
    pub fn take(&mut self, state: &ArmState) -> Option<(usize, f64)> {
        let measured = state.velocity_source == VelocitySource::Measured;
        self.has_velocity |= measured && state.velocity.iter().take(self.dof).any(|v| *v != 0.0);
        let before = self.before.replace(*state)?;
        let dt = state.stamp.seconds_since(before.stamp);
        if !self.has_velocity(state) || !self.has_velocity(&before) || !(0.0..=LONGEST_GAP).contains(&dt) {
            (self.difference, self.speed) = ([0.0; MAX_DOF], [0.0; MAX_DOF]);
            return None;
        }
        let kept = (-dt / MEMORY).exp();
        let mut worst: Option<(usize, f64, f64)> = None;
        let steps = state.position.iter().zip(&before.position).zip(state.velocity.iter().zip(&before.velocity));
        let own = self.difference.iter_mut().zip(&mut self.speed).zip(&self.fastest);
        for (j, (((q, q_before), (v, v_before)), ((difference, speed), top))) in
            steps.zip(own).enumerate().take(self.dof)
        {
            let (v, v_before) = (v.max(-top).min(*top), v_before.max(-top).min(*top));
            let moved = q - q_before;
            *difference = (*difference + moved - 0.5 * (v + v_before) * dt) * kept;
            // Either may be the one that lies: the lag of a filter counts where both see a motion.
            let seen = if dt > 0.0 { v.abs().min(moved.abs() / dt) } else { 0.0 };
            *speed = seen.max(*speed * kept);
            let excess = difference.abs() - TOLERANCE - FILTER_LAG * *speed;
            if excess > 0.0 && worst.is_none_or(|(_, _, by)| excess > by) {
                worst = Some((j, *difference, excess));
            }
        }
        worst.map(|(j, difference, _)| (j, difference))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_core::clock::Mono;

    fn state(k: u64, q: f64, v: f64) -> ArmState {
        ArmState {
            seq: k + 1,
            stamp: Mono(k * 10_000_000),
            dof: 1,
            position: joints_of(&[q]),
            velocity: joints_of(&[v]),
            velocity_source: VelocitySource::Measured,
            ..ArmState::default()
        }
    }

    /// Returns after how many readings 10 ms apart a contradiction is found.
    fn found_after(of: impl Fn(f64) -> (f64, f64)) -> Option<u64> {
        let mut agreement = Agreement::new(&[3.0]);
        agreement.take(&state(0, of(0.0).0, 1e-3));
        (1..500).find(|&k| {
            let (q, v) = of(0.01 * k as f64);
            agreement.take(&state(k, q, v)).is_some()
        })
    }

    #[test]
    fn a_velocity_without_motion_and_a_motion_without_velocity_are_found() {
        assert!((5..12).contains(&found_after(|_| (0.5, 1.0)).unwrap()), "{:?}", found_after(|_| (0.5, 1.0)));
        assert!(found_after(|t| (0.4 * t, 0.0)).is_some_and(|k| k < 25), "{:?}", found_after(|t| (0.4 * t, 0.0)));
        assert!(found_after(|t| (t, -t.min(1.0))).is_some());
    }

    #[test]
    fn a_filtered_velocity_and_noise_are_no_contradiction() {
        // A sine of 0.8 rad at 2.5 rad/s, whose velocity is filtered with 60 ms.
        let (a, w) = (0.8, 3.2);
        assert_eq!(found_after(|t| (a * (w * t).sin(), a * w * (w * (t - 0.06)).cos())), None);
        let noise = |t: f64| 0.004 * (977.0 * t).sin();
        assert_eq!(found_after(|t| (0.3 * t + noise(t), 0.3 + 20.0 * noise(t))), None);
    }

    #[test]
    fn zeros_of_an_arm_without_velocities_are_no_evidence() {
        let mut agreement = Agreement::new(&[3.0]);
        assert!((0..300).all(|k| agreement.take(&state(k, 0.01 * k as f64, 0.0)).is_none()));
        assert!(!agreement.has_velocity(&state(0, 0.0, 0.0)));
    }
}
