//! Gripper commands of a log, with their times in its motion.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::path::Path;

use super::recorded::RecordedError;
use dimos_log::replay::{LogReader, Payload, ReplayError, Selection};

/// A recorded gripper command.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedGrip {
    /// Time since the motion's start [s].
    pub time: f64,
    /// The arm.
    pub arm: String,
    /// Position [m, or rad for a rotary gripper].
    pub position: f64,
    /// Largest force, in the gripper's force unit; `None`: the device's own.
    pub force: Option<f64>,
    /// Fraction of the top speed; `None`: the device's own.
    pub speed: Option<f64>,
}

/// Reads the gripper commands of these arms within ticks, in order of time. Of those before, the last one of each arm
/// counts for the start: the gripper is then where the motion begins with it. The log must be whole up
/// to `to` [ns].
pub fn read(
    path: &Path,
    arms: &[String],
    ticks: RangeInclusive<u64>,
    period: f64,
    to: u64,
) -> Result<Vec<RecordedGrip>, RecordedError> {
    let mut log = LogReader::open(path)?;
    let topics = arms.iter().map(|arm| format!("/dimos/outputs/{arm}")).collect();
    log.select(Selection { topics, to, ..Selection::default() })?;
    let (mut counts, mut before, mut grips) = (BTreeMap::new(), BTreeMap::new(), Vec::new());
    loop {
        let entry = match log.next_entry() {
            Ok(Some(entry)) => entry,
            Ok(None) => break,
            // It is in the loss.
            Err(ReplayError::Cut { .. } | ReplayError::Damaged { .. }) => continue,
            Err(e) => return Err(e.into()),
        };
        let (Payload::ArmOutput(output), Some(arm)) = (&entry.data, entry.topic.strip_prefix("/dimos/outputs/")) else {
            continue;
        };
        if counts.insert(arm.to_owned(), output.gripper_seq).unwrap_or_default() == output.gripper_seq {
            continue;
        }
        let grip = RecordedGrip {
            time: output.tick.saturating_sub(*ticks.start()) as f64 * period,
            arm: arm.to_owned(),
            position: output.gripper,
            force: output.gripper_force.first().copied(),
            speed: output.gripper_speed.first().copied(),
        };
        if output.tick < *ticks.start() {
            before.insert(grip.arm.clone(), grip);
        } else if ticks.contains(&output.tick) {
            grips.push(grip);
        }
    }
    RecordedError::unless_whole(path, &log)?;
    Ok(before.into_values().chain(grips).collect())
}
