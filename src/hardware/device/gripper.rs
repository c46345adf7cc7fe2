//! A stop is for the gripper too: what still moves after it is held where it is. A gripper that stands, on a workpiece
//! say, is left as it is: a new target would loosen its grip.

use std::time::Duration;

use crate::clock::Mono;

/// For how long after a stop the gripper is watched.
const WATCH: Duration = Duration::from_secs(2);
/// A difference that is motion, and no noise or give [m].
const STEP: f64 = 0.000_25;

/// Watches a gripper after a stop. Two steps the same way are motion: one may lie before the stop, where the opening
/// is not read in every cycle.
#[derive(Debug, Clone, Copy, Default)]
pub struct GripperStop {
    until: Option<Mono>,
    last: Option<f64>,
    step: f64,
}

impl GripperStop {
    /// The arm was told to stop.
    pub fn begin(&mut self, now: Mono) {
        *self = Self { until: Some(now.after(WATCH)), last: None, step: 0.0 };
    }

    /// The gripper was sent somewhere after the stop, or everything is known.
    pub fn end(&mut self) {
        self.until = None;
    }

    /// Takes an opening [m] that was read after the stop. Where the gripper is to be held, once it is seen moving.
    pub fn look(&mut self, opening: f64, now: Mono) -> Option<f64> {
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

    fn looks(openings: &[f64]) -> Option<f64> {
        let mut stop = GripperStop::default();
        stop.begin(Mono(0));
        openings.iter().zip(1..).find_map(|(opening, i)| stop.look(*opening, Mono(i * 10_000_000)))
    }

    #[test]
    fn what_moves_is_held_where_it_is() {
        assert_eq!(looks(&[0.05, 0.049, 0.048, 0.047]), Some(0.048));
        // Slowly, between noise.
        assert_eq!(looks(&[0.05, 0.0501, 0.0502, 0.0503, 0.0504, 0.0505, 0.0506, 0.0507]), Some(0.0506));
    }

    #[test]
    fn what_stands_is_left_alone() {
        assert_eq!(looks(&[0.05, 0.0501, 0.0499, 0.0501, 0.05]), None, "noise");
        assert_eq!(looks(&[0.05, 0.04, 0.04, 0.04]), None, "it had come to rest when the old opening was replaced");
        assert_eq!(looks(&[0.05, 0.0497, 0.05, 0.0497]), None, "give");
        let mut stop = GripperStop::default();
        assert_eq!((stop.look(0.05, Mono(1)), stop.look(0.04, Mono(2)), stop.look(0.03, Mono(3))), (None, None, None));
        stop.begin(Mono(0));
        assert_eq!(stop.look(0.05, Mono(1)), None);
        assert_eq!(stop.look(0.04, Mono(3_000_000_000)), None, "too late: somebody moves it by hand");
        assert_eq!(stop.look(0.03, Mono(3_000_000_001)), None);
    }
}
