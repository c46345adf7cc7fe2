//! Holds a gripper that still moves after a stop of the arm. A gripper at rest, for example on a workpiece, gets no new
//! target: that would loosen its grip.

use std::time::Duration;

use crate::clock::Mono;

/// How long the gripper is monitored after a stop.
const WATCH: Duration = Duration::from_secs(2);
/// Smallest change of the opening that counts as motion rather than noise or compliance [m].
const STEP: f64 = 0.000_25;

/// Monitors a gripper after a stop. Two steps in the same direction count as motion: a single one may lie before the
/// stop, because the opening is not read in every cycle.
#[derive(Debug, Clone, Copy, Default)]
pub struct GripperStop {
    until: Option<Mono>,
    last: Option<f64>,
    step: f64,
}

impl GripperStop {
    /// Starts monitoring, after a stop was sent.
    pub fn begin(&mut self, now: Mono) {
        *self = Self { until: Some(now.after(WATCH)), last: None, step: 0.0 };
    }

    /// Stops monitoring: the gripper was commanded after the stop, or is at rest.
    pub fn end(&mut self) {
        self.until = None;
    }

    /// Takes an opening [m] read after the stop. Returns the opening at which to hold the gripper, once it is seen
    /// moving.
    pub fn observe(&mut self, opening: f64, now: Mono) -> Option<f64> {
        self.until = self.until.filter(|until| now < *until);
        self.until?;
        let Some(last) = self.last else {
            self.last = Some(opening);
            return None;
        };
        let step = opening - last;
        if step.abs() < STEP {
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
        openings.iter().zip(1..).find_map(|(opening, i)| stop.observe(*opening, Mono(i * 10_000_000)))
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
        assert_eq!(
            (stop.observe(0.05, Mono(1)), stop.observe(0.04, Mono(2)), stop.observe(0.03, Mono(3))),
            (None, None, None)
        );
        stop.begin(Mono(0));
        assert_eq!(stop.observe(0.05, Mono(1)), None);
        assert_eq!(stop.observe(0.04, Mono(3_000_000_000)), None, "too late: this may be motion by hand");
        assert_eq!(stop.observe(0.03, Mono(3_000_000_001)), None);
    }
}
