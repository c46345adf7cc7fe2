//! Holds a gripper that still moves after a stop of the arm, with the force of its last command. A gripper at rest, for
//! example on a workpiece, gets no new target: that would loosen its grip.

use std::time::Duration;

use dimos_core::arm::GripperUnit;
use dimos_core::clock::Mono;

/// How long the gripper is monitored after a stop.
const WATCH: Duration = Duration::from_secs(2);
/// Smallest change of the position that counts as motion rather than noise or compliance [m]; of a rotary jaw [rad].
const STEP: f64 = 0.000_25;
const ROTARY_STEP: f64 = 0.005;

/// Monitors a gripper after a stop. Two steps in the same direction count as motion: a single one may lie before the
/// stop, because the position is not read in every cycle.
#[derive(Debug, Clone, Copy, Default)]
pub struct GripperStop {
    until: Option<Mono>,
    last: Option<f64>,
    step: f64,
    force: Option<f64>,
}

impl GripperStop {
    /// Starts monitoring, after a stop was sent.
    pub fn begin(&mut self, now: Mono) {
        *self = Self { until: Some(now.after(WATCH)), last: None, step: 0.0, force: self.force };
    }

    /// Stops monitoring: the gripper was commanded after the stop, or is at rest.
    pub fn end(&mut self) {
        self.until = None;
    }

    /// Notes the force that the gripper was commanded with; `None`: the device's own.
    pub fn commanded(&mut self, force: Option<f64>) {
        self.force = force;
    }

    /// Returns the force with which to hold the gripper: that of its last command.
    pub fn force(&self) -> Option<f64> {
        self.force
    }

    /// Takes a position [m or rad] read after the stop. Returns the position at which to hold the gripper, once it is
    /// seen moving.
    pub fn observe(&mut self, opening: f64, unit: GripperUnit, now: Mono) -> Option<f64> {
        let smallest = match unit {
            GripperUnit::Meters => STEP,
            GripperUnit::Radians => ROTARY_STEP,
            GripperUnit::OnOff => f64::INFINITY,
        };
        self.until = self.until.filter(|until| now < *until);
        self.until?;
        let Some(last) = self.last else {
            self.last = Some(opening);
            return None;
        };
        let step = opening - last;
        if step.abs() < smallest {
            return None;
        }
        if step * self.step > 0.0 {
            self.end();
            return Some(opening);
        }
        (self.last, self.step) = (Some(opening), step);
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn held_at(openings: &[f64]) -> Option<f64> {
        let mut stop = GripperStop::default();
        stop.begin(Mono(0));
        let at = |i: u64| Mono(i * 10_000_000);
        openings.iter().zip(1..).find_map(|(opening, i)| stop.observe(*opening, GripperUnit::Meters, at(i)))
    }

    #[test]
    fn a_moving_gripper_is_held_where_it_is() {
        assert_eq!(held_at(&[0.05, 0.049, 0.048, 0.047]), Some(0.048));
        // Slow motion with noise.
        assert_eq!(held_at(&[0.05, 0.0501, 0.0502, 0.0503, 0.0504, 0.0505, 0.0506, 0.0507]), Some(0.0506));
    }

    #[test]
    fn a_gripper_at_rest_gets_no_target() {
        assert_eq!(held_at(&[0.05, 0.0501, 0.0499, 0.0501, 0.05]), None, "noise");
        assert_eq!(held_at(&[0.05, 0.04, 0.04, 0.04]), None, "it came to a stop before the second reading");
        assert_eq!(held_at(&[0.05, 0.0497, 0.05, 0.0497]), None, "compliance");
        let mut stop = GripperStop::default();
        let metres = GripperUnit::Meters;
        let unasked = [0.05, 0.04, 0.03].map(|opening| stop.observe(opening, metres, Mono(1)));
        assert_eq!(unasked, [None; 3]);
        stop.begin(Mono(0));
        assert_eq!(stop.observe(0.05, metres, Mono(1)), None);
        assert_eq!(stop.observe(0.04, metres, Mono(3_000_000_000)), None, "too late: this may be motion by hand");
        assert_eq!(stop.observe(0.03, metres, Mono(3_000_000_001)), None);
    }

    #[test]
    fn the_noise_of_a_rotary_jaw_is_no_motion() {
        let held = |angles: &[f64]| {
            let mut stop = GripperStop::default();
            stop.begin(Mono(0));
            angles.iter().find_map(|angle| stop.observe(*angle, GripperUnit::Radians, Mono(1)))
        };
        assert_eq!(held(&[1.0, 1.002, 1.004, 1.003, 1.001]), None);
        assert_eq!(held(&[1.0, 0.98, 0.96, 0.94]), Some(0.96));
    }

    #[test]
    fn the_force_of_the_last_command_outlives_a_stop() {
        let mut stop = GripperStop::default();
        stop.commanded(Some(12.0));
        stop.begin(Mono(0));
        assert_eq!(stop.force(), Some(12.0));
        stop.commanded(None);
        assert_eq!(stop.force(), None);
    }
}
