//! What the servos' counts mean: zero and range of each joint, and where the gripper is closed and open. Every
//! conversion between counts and rad or m is in this file.

use std::f64::consts::TAU;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{DOF, OPEN, SERVOS};

/// Counts of a turn.
pub const TURN: f64 = 4096.0; // YOUR ARM
/// Range of a joint according to the data sheet: 170° on both sides of the middle. YOUR ARM: one for each joint.
const JOINT: Range = Range { zero: 2048, low: 114, high: 3982, reversed: false };
/// The gripper, closed and open. YOUR ARM.
const GRIPPER: Range = Range { zero: 1000, low: 1000, high: 3000, reversed: false };

/// Zero and range of a servo [counts]. The gripper is closed at `low` and open at `high`, a reversed one the other way
/// round; it needs no zero.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Range {
    /// Position at 0 rad.
    pub zero: i32,
    /// Lowest position.
    pub low: i32,
    /// Highest position.
    pub high: i32,
    /// Whether the joint turns to its data sheet's + when the counts decrease.
    #[serde(default)]
    pub reversed: bool,
}

impl Range {
    /// The angle of a position [rad].
    pub fn angle(&self, counts: i32) -> f64 {
        self.sign() * f64::from(counts - self.zero) * TAU / TURN
    }

    /// −1 for a reversed joint: also for its velocity.
    pub fn sign(&self) -> f64 {
        if self.reversed { -1.0 } else { 1.0 }
    }

    /// The position in the range that is closest to an angle.
    pub fn counts(&self, angle: f64) -> i32 {
        self.inside((self.sign() * angle * TURN / TAU).round() as i32 + self.zero)
    }

    /// The position in the range that is closest to another one.
    pub fn inside(&self, counts: i32) -> i32 {
        counts.max(self.low).min(self.high)
    }

    /// The angles of both ends [rad], the lower one first.
    pub fn angles(&self) -> (f64, f64) {
        let (a, b) = (self.angle(self.low), self.angle(self.high));
        (a.min(b), a.max(b))
    }
}

/// Zero and range of all servos.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Calibration([Range; SERVOS]);

impl Default for Calibration {
    fn default() -> Self {
        let mut ranges = [JOINT; SERVOS];
        ranges[DOF] = GRIPPER;
        Self(ranges)
    }
}

impl Calibration {
    /// Checks the ranges of a blueprint; none are those of the data sheet. What is wrong, in a sentence without full
    /// stop.
    pub fn of(ranges: &[Range]) -> Result<Self, String> {
        if ranges.is_empty() {
            return Ok(Self::default());
        }
        let turn = 0..TURN as i32;
        let within = |r: &Range| [r.zero, r.low, r.high].iter().all(|counts| turn.contains(counts));
        if let Some(wrong) = ranges.iter().position(|r| !within(r) || r.low >= r.high) {
            return Err(format!("servo {}: its zero and range are not within 0 to {}", wrong + 1, TURN - 1.0));
        }
        let ranges = ranges.try_into().map_err(|_| format!("{} servos are given, not {SERVOS}", ranges.len()))?;
        Ok(Self(ranges))
    }

    /// The joints, from the base.
    pub fn joints(&self) -> &[Range] {
        self.0.split_last().map_or(&[], |(_, joints)| joints)
    }

    /// The gripper.
    pub fn gripper(&self) -> Range {
        self.0[DOF]
    }

    /// The position of each servo inside its range.
    pub fn inside(&self, positions: [i32; SERVOS]) -> [i32; SERVOS] {
        let mut inside = positions;
        inside.iter_mut().zip(&self.0).for_each(|(position, range)| *position = range.inside(*position));
        inside
    }

    /// The gripper's opening at a position [m].
    pub fn opening(&self, counts: i32) -> f64 {
        let (closed, open) = self.jaw();
        f64::from(counts - closed) / f64::from(open - closed) * OPEN
    }

    /// The gripper's position at an opening [m].
    pub fn of_opening(&self, opening: f64) -> i32 {
        let (closed, open) = self.jaw();
        closed + (opening / OPEN * f64::from(open - closed)).round() as i32
    }

    /// The gripper's positions closed and open.
    fn jaw(&self) -> (i32, i32) {
        let Range { low, high, reversed, .. } = self.gripper();
        if reversed { (high, low) } else { (low, high) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_are_angles_by_the_zero_and_openings_by_the_range() {
        let range = Range { zero: 1000, low: 500, high: 3000, reversed: false };
        assert_eq!((range.angle(1000 + 1024), range.counts(TAU / 4.0)), (TAU / 4.0, 2024));
        let reversed = Range { zero: 2000, reversed: true, ..range };
        assert_eq!((reversed.angle(2000 + 1024), reversed.counts(-TAU / 4.0)), (-TAU / 4.0, 3000));
        assert_eq!(reversed.angles(), (reversed.angle(3000), reversed.angle(500)));
        assert_eq!((range.counts(-9.0), range.counts(9.0)), (500, 3000), "never beyond the range");
        let calibration = Calibration::of(&[range; SERVOS]).unwrap();
        assert_eq!((calibration.opening(500), calibration.opening(3000)), (0.0, OPEN));
        assert_eq!(calibration.of_opening(OPEN / 2.0), 1750);
        let calibration = Calibration::of(&[Range { reversed: true, ..range }; SERVOS]).unwrap();
        assert_eq!((calibration.opening(3000), calibration.of_opening(OPEN)), (0.0, 500), "a gripper that is reversed");
        assert_eq!(Calibration::of(&[]), Ok(Calibration::default()));
        assert!(Calibration::of(&[range]).is_err() == (SERVOS > 1));
        for wrong in [Range { low: 3000, ..range }, Range { high: 4096, ..range }, Range { zero: -1, ..range }] {
            assert!(Calibration::of(&[wrong; SERVOS]).unwrap_err().starts_with("servo 1: "), "{wrong:?}");
        }
    }
}
