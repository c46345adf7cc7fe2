//! Steps of a recorded path that no arm makes: a path with one is of two publishers, or its times are wrong.

use std::f64::consts::TAU;

use crate::cli::exit::{Failure, Result};

/// A larger step between two states is checked [rad].
const MIN_STEP: f64 = 0.05;
/// No joint of an arm is faster [rad/s].
const MAX_SPEED: f64 = 20.0;
/// A joint that goes one way and back in two steps, this often, is two joints.
const MOST_BACK: u32 = 1;

/// What a path was read from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Recording {
    /// The joint states of a topic: whatever was published on it.
    Topic(&'static str),
    /// A table of points.
    File,
}

/// Checks the steps of a path, in order.
pub struct Steps<'a> {
    joints: &'a [String],
    from: Recording,
    /// The latest step of each joint if it was large [rad], its time [s], and how often the joint went back at once.
    last: Vec<(f64, f64, u32)>,
}

impl<'a> Steps<'a> {
    /// Creates one for these joints.
    pub fn new(joints: &'a [String], from: Recording) -> Self {
        Self { joints, from, last: vec![(0.0, 0.0, 0); joints.len()] }
    }

    /// Refuses a step that no arm makes: at a time [s], within a time [s].
    pub fn check(&mut self, at: f64, seconds: f64, from: &[f64], to: &[f64]) -> Result<()> {
        for ((joint, last), (from, to)) in self.joints.iter().zip(&mut self.last).zip(from.iter().zip(to)) {
            let step = to - from;
            if step.abs() <= MIN_STEP {
                (last.0, last.1) = (0.0, 0.0);
                continue;
            }
            let jump = format!("at {at:.3} s {joint} goes from {from:.4} to {to:.4} rad");
            if step.abs() > MAX_SPEED * seconds {
                return Err(self.from.refuse(&jump, seconds, step));
            }
            // Two publishers in turn, each too seldom for its steps to look fast.
            let both = last.1 + seconds;
            if last.0 * step < 0.0 && both <= self.from.longest_back() {
                if last.2 >= MOST_BACK {
                    return Err(self.from.refuse(&format!("{jump} after the way back, twice"), both, step));
                }
                last.2 += 1;
            }
            (last.0, last.1) = (step, seconds);
        }
        Ok(())
    }
}

impl Recording {
    /// Returns the longest time of two steps there and back that are not believed [s]. Who writes a table may want such
    /// a motion, unless it is as fast as a recording.
    fn longest_back(self) -> f64 {
        match self {
            Self::Topic(_) => 1.0,
            Self::File => 0.2,
        }
    }

    fn refuse(self, jump: &str, seconds: f64, step: f64) -> Failure {
        let (why, hint) = match self {
            _ if (step.abs() - TAU).abs() < MIN_STEP => {
                ("a whole turn".to_owned(), "only a planner follows joints that turn without limits")
            }
            Self::Topic(topic) => (format!("two publishers write {topic}"), "record the states of one of them only"),
            Self::File => (
                format!("no joint is faster than {MAX_SPEED} rad/s"),
                "the first column, or time_from_start, is in seconds; the rows of one arm belong in one file",
            ),
        };
        Failure::usage(format!("{jump} within {:.0} ms: {why}", seconds * 1e3)).hint(hint)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Checks positions of one joint, a period apart.
    fn checked(from: Recording, period: f64, positions: &[f64]) -> bool {
        let joints = ["a".to_owned()];
        let mut steps = Steps::new(&joints, from);
        positions.windows(2).enumerate().all(|(k, w)| steps.check(k as f64 * period, period, &w[..1], &w[1..]).is_ok())
    }

    #[test]
    fn two_publishers_in_turn_are_no_motion() {
        let topic = Recording::Topic("/joint_states");
        for (from, period) in [(topic, 0.05), (topic, 0.1), (topic, 0.3), (Recording::File, 0.05)] {
            assert!(!checked(from, period, &[0.0, 0.4, 0.0, 0.4]), "{from:?} {period}");
            assert!(!checked(from, period, &[0.0, 0.0, 0.4, 0.0, 0.0, 0.4, 0.0]), "one is twice as fast: {period}");
            assert!(!checked(from, period, &[0.0, 0.3, -0.2, 0.01, 0.31, -0.19]), "three of them: {period}");
        }
    }

    #[test]
    fn fast_motions_there_and_back_are_motions() {
        let topic = Recording::Topic("/joint_states");
        // A swing of 0.5 rad at 1 Hz, ten states a second.
        let swing: Vec<f64> = (0..50).map(|k| 0.5 * (f64::from(k) * 0.1 * TAU).sin()).collect();
        assert!(checked(topic, 0.1, &swing));
        // Points of a table, a second apart.
        assert!(checked(Recording::File, 1.0, &[0.0, 0.5, 0.0, 0.5, 0.0]));
        assert!(!checked(Recording::File, 0.001, &[0.0, 0.5]), "as a table in milliseconds");
    }
}
