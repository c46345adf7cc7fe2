//! What the servos' counts mean: each joint's range and its zero, from LeRobot's calibration file or the data sheet.

use std::f64::consts::TAU;
use std::path::Path;

use serde::Deserialize;

use super::protocol::{SERVOS, TURN};
use super::{DOF, SPEC};
use dimos_core::bounded;

/// The joints and the gripper, as LeRobot calls them.
pub const NAMES: [&str; SERVOS] =
    ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"];
/// Ranges of the joints and the gripper [rad], from the arm's model file.
const DATA_SHEET: [(f64, f64); SERVOS] =
    [(-1.920, 1.920), (-1.745, 1.745), (-1.690, 1.690), (-1.658, 1.658), (-2.744, 2.841), (-0.175, 1.745)];
/// The middle of a turn [counts]: zero of the data sheet.
const MIDDLE: f64 = 2048.0;
/// Distance that goals of the joints keep from the seam of the encoder [counts]: a joint that rests beside its goal
/// stays on its side of the seam. A servo drives round the whole turn to a goal on the other side.
pub const SEAM_MARGIN: i32 = {
    let (sag, degree) = (2.0 * SPEC.accuracy + SPEC.droop, TAU / 360.0);
    ((if sag > degree { sag } else { degree }) * TURN / TAU) as i32 + 1
};
/// Highest position of a turn [counts].
pub const LAST: i32 = TURN as i32 - 1;

/// A servo in LeRobot's file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
pub struct Servo {
    /// Its number on the line.
    pub id: u8,
    /// Direction for LeRobot's percentages; always 0 for this arm.
    #[serde(default)]
    pub drive_mode: u8,
    /// Homing offset: what the servo subtracts from its encoder [counts].
    pub homing_offset: i32,
    /// Lowest position [counts].
    pub range_min: i32,
    /// Highest position [counts].
    pub range_max: i32,
}

/// Returns the text of LeRobot's file, as LeRobot writes it.
pub fn file(servos: &[Servo; SERVOS]) -> String {
    let entry = |(name, servo): (&str, &Servo)| {
        let Servo { id, drive_mode, homing_offset, range_min, range_max } = servo;
        let values = [
            ("id", i32::from(*id)),
            ("drive_mode", i32::from(*drive_mode)),
            ("homing_offset", *homing_offset),
            ("range_min", *range_min),
            ("range_max", *range_max),
        ];
        let lines = values.map(|(key, value)| format!("        \"{key}\": {value}"));
        format!("    \"{name}\": {{\n{}\n    }}", lines.join(",\n"))
    };
    let entries: Vec<String> = NAMES.into_iter().zip(servos).map(entry).collect();
    format!("{{\n{}\n}}", entries.join(",\n"))
}

/// Range and zero of a servo.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Range {
    /// Lowest goal [counts].
    pub low: i32,
    /// Highest goal.
    pub high: i32,
    /// The range in the servo: lowest and highest position [counts].
    pub registers: (i32, i32),
    /// Position of zero [counts].
    zero: f64,
    /// The offset that the servo must have; `None`: any.
    pub offset: Option<i32>,
}

impl Range {
    /// Returns the angle of a position [rad].
    pub fn angle(&self, counts: i32) -> f64 {
        (f64::from(counts) - self.zero) * TAU / TURN
    }

    /// Returns the position inside the range that is closest to an angle [counts].
    pub fn counts(&self, angle: f64) -> i32 {
        ((angle * TURN / TAU + self.zero).round() as i32).max(self.low).min(self.high)
    }

    /// Returns the angles of the ends [rad].
    pub fn angles(&self) -> (f64, f64) {
        (self.angle(self.low), self.angle(self.high))
    }
}

/// Ranges and zeros of all servos.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Calibration(pub [Range; SERVOS]);

impl Default for Calibration {
    /// That of the data sheet: zero in the middle of a turn.
    fn default() -> Self {
        Self(DATA_SHEET.map(|(low, high)| {
            let counts = |angle: f64| angle * TURN / TAU + MIDDLE;
            let (low, high) = (counts(low).ceil() as i32, counts(high).floor() as i32);
            Range { low, high, registers: (low, high), zero: MIDDLE, offset: None }
        }))
    }
}

impl Calibration {
    /// Reads LeRobot's file of an arm whose servos have the numbers from `first` on; zero is the middle of each range.
    /// The error is a sentence without full stop.
    pub fn load(path: &Path, first: u8) -> Result<Self, String> {
        Self::read(path, first).map(|servos| Self::of(&servos))
    }

    /// Reads LeRobot's file as it is.
    pub fn read(path: &Path, first: u8) -> Result<[Servo; SERVOS], String> {
        let text =
            bounded::read_text(path, bounded::SMALL).map_err(|e| format!("cannot read {}: {e}", path.display()))?;
        entries(&text, first).map_err(|e| format!("{}: {e}", path.display()))
    }

    /// Reads the text of LeRobot's file.
    pub fn parse(text: &str, first: u8) -> Result<Self, String> {
        entries(text, first).map(|servos| Self::of(&servos))
    }

    fn of(servos: &[Servo; SERVOS]) -> Self {
        let mut joint = 0;
        Self(servos.map(|servo| {
            joint += 1;
            let (low, high) = if joint <= DOF { clear_of_seam(&servo) } else { (servo.range_min, servo.range_max) };
            Range {
                low,
                high,
                registers: (servo.range_min, servo.range_max),
                zero: 0.5 * f64::from(servo.range_min + servo.range_max),
                offset: Some(servo.homing_offset),
            }
        }))
    }
}

/// Returns the lowest and the highest goal of a joint: its range without the parts beside the seam.
fn clear_of_seam(servo: &Servo) -> (i32, i32) {
    (servo.range_min.max(SEAM_MARGIN), servo.range_max.min(LAST - SEAM_MARGIN))
}

fn entries(text: &str, first: u8) -> Result<[Servo; SERVOS], String> {
    let file: std::collections::BTreeMap<String, Servo> =
        serde_json::from_str(text).map_err(|e| format!("this is no calibration of LeRobot: {e}"))?;
    let mut servos = [Servo::default(); SERVOS];
    for ((name, id), servo) in NAMES.into_iter().zip(first..).zip(&mut servos) {
        let entry = file.get(name).ok_or_else(|| format!("{name} is missing"))?;
        if entry.id != id {
            return Err(format!("{name} is servo {}, expected {id}", entry.id));
        }
        let (low, high, offset) = (entry.range_min, entry.range_max, entry.homing_offset);
        if !(0 <= low && low < high && high < TURN as i32) {
            return Err(format!("{name}: {low} to {high} is not a range within 0 to 4095"));
        }
        if !(-2047..=2047).contains(&offset) {
            return Err(format!("{name}: {offset} is not an offset within -2047 to 2047"));
        }
        let (lowest, highest) = clear_of_seam(entry);
        if lowest >= highest {
            return Err(format!("{name}: {low} to {high} is beside the seam of its encoder (0 and 4095)"));
        }
        *servo = *entry;
    }
    Ok(servos)
}

#[cfg(test)]
mod tests {
    use super::*;

    const FILE: &str = r#"{
        "shoulder_pan": {"id": 1, "drive_mode": 0, "homing_offset": -50, "range_min": 758, "range_max": 3420},
        "shoulder_lift": {"id": 2, "drive_mode": 0, "homing_offset": 12, "range_min": 900, "range_max": 3200},
        "elbow_flex": {"id": 3, "drive_mode": 0, "homing_offset": 0, "range_min": 900, "range_max": 3100},
        "wrist_flex": {"id": 4, "drive_mode": 0, "homing_offset": 7, "range_min": 950, "range_max": 3100},
        "wrist_roll": {"id": 5, "drive_mode": 0, "homing_offset": 1, "range_min": 0, "range_max": 4095},
        "gripper": {"id": 6, "drive_mode": 0, "homing_offset": 900, "range_min": 2000, "range_max": 3500}
    }"#;

    #[test]
    fn zero_is_the_middle_of_the_range_in_lerobots_file() {
        let Calibration([pan, .., gripper]) = Calibration::parse(FILE, 1).unwrap();
        assert_eq!((pan.low, pan.high, pan.offset), (758, 3420, Some(-50)));
        assert!(pan.angle(2089).abs() < 1e-12 && (pan.angle(2089 + 1024) - TAU / 4.0).abs() < 1e-12);
        assert_eq!(pan.counts(TAU / 8.0), 2089 + 512);
        assert_eq!((pan.counts(9.0), pan.counts(-9.0)), (3420, 758), "never beyond the range");
        assert_eq!(gripper.angles().1, 750.0 * TAU / TURN);
    }

    #[test]
    fn goals_keep_clear_of_the_seam_and_zero_stays_where_it_is() {
        let Calibration([pan, .., roll, gripper]) = Calibration::parse(FILE, 1).unwrap();
        assert_eq!((pan.low, pan.high), pan.registers);
        assert_eq!((roll.low, roll.high, roll.registers), (SEAM_MARGIN, 4095 - SEAM_MARGIN, (0, 4095)));
        assert!(SEAM_MARGIN == 111 && (roll.angles().1 - 2.9706).abs() < 1e-3, "0.17 rad: {:?}", roll.angles());
        assert!(roll.angle(2048) > 0.0 && roll.angle(2047) < 0.0);
        let at_the_end = FILE.replace("2000, \"range_max\": 3500", "0, \"range_max\": 3500");
        assert_eq!(Calibration::parse(&at_the_end, 1).unwrap().0[5].low, 0, "the gripper has an end stop");
        assert_eq!(gripper.registers, (2000, 3500));
    }

    #[test]
    fn a_file_that_was_written_is_read_as_it_was() {
        let servos = entries(FILE, 1).unwrap();
        let text = file(&servos);
        assert_eq!(entries(&text, 1), Ok(servos));
        let begin = "{\n    \"shoulder_pan\": {\n        \"id\": 1,\n        \"drive_mode\": 0,\n        \"homing_offset\": -50,";
        assert!(text.starts_with(begin) && text.ends_with("\"range_max\": 3500\n    }\n}"), "{text}");
    }

    #[test]
    fn mistakes_in_the_file_are_named() {
        let wrong = |from: &str, to: &str| Calibration::parse(&FILE.replace(from, to), 1).unwrap_err();
        assert_eq!(wrong("wrist_roll", "wrist"), "wrist_roll is missing");
        assert_eq!(wrong(r#""id": 3"#, r#""id": 4"#), "elbow_flex is servo 4, expected 3");
        assert_eq!(wrong("-50", "2048"), "shoulder_pan: 2048 is not an offset within -2047 to 2047");
        assert_eq!(wrong("3420", "4096"), "shoulder_pan: 758 to 4096 is not a range within 0 to 4095");
        let beside = FILE.replace("758, \"range_max\": 3420", "0, \"range_max\": 90");
        let error = Calibration::parse(&beside, 1).unwrap_err();
        assert_eq!(error, "shoulder_pan: 0 to 90 is beside the seam of its encoder (0 and 4095)");
        assert!(wrong("range_max", "max").starts_with("this is no calibration of LeRobot"));
        let error = Calibration::load(Path::new("/no/such/file"), 1).unwrap_err();
        assert!(error.starts_with("cannot read /no/such/file: "), "{error}");
    }
}
