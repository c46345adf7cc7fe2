//! Things that go wrong on purpose, without motion: what the arm reports, how soon, and how it is cleared. What goes
//! over the wire meanwhile is in the capture.

use std::time::Duration;

use super::{End, Tour, skipped};
use crate::adapter::JointReading;
use crate::sim::faults::{Fault, FaultKind};
use dimos_core::clock::{Clock, MonotonicClock};

/// What a person does, how it is undone, and the fault that does the same in an emulator.
const ACTS: [(&str, &str, &str, Option<FaultKind>); 4] = [
    ("E-stop", "press the E-stop button", "release the E-stop button", Some(FaultKind::Estop)),
    ("safeguard", "open the safeguard input (a door, a light curtain)", "close the safeguard input", None),
    ("cable out", "pull the cable to the arm", "plug the cable in again", Some(FaultKind::Disconnect)),
    ("pendant", "take over at the pendant or the vendor's page: another mode, or pause", "give it back", None),
];
/// How long a person has for an act, and an emulator.
const TIME: Duration = Duration::from_secs(40);
const PLAYED: Duration = Duration::from_secs(5);
/// How long an emulator's fault lasts [s].
const LASTS: f64 = 0.6;

impl Tour<'_> {
    /// Plays the errors, one after the other.
    pub(super) fn errors(&mut self) -> Result<String, End> {
        if self.emulator.is_none() && !self.person.is_there() {
            return skipped("no person is at the arm to press the E-stop button");
        }
        let (mut seen, mut left_out) = (Vec::new(), Vec::new());
        for (name, act, undo, kind) in ACTS {
            self.prepare()?;
            let limit = match (self.emulator, kind) {
                (Some(emulator), Some(kind)) if emulator.inject(Fault::new(kind).lasting(LASTS)).is_ok() => PLAYED,
                (Some(_), _) => {
                    left_out.push(format!("{name} (not in this emulator)"));
                    continue;
                }
                (None, _) => {
                    self.person.tell(&format!("{act} ({} s)", TIME.as_secs()));
                    TIME
                }
            };
            let began = MonotonicClock.now();
            let Some(what) = self.noticed(limit)? else {
                left_out.push(format!("{name} (nothing seen within {} s)", limit.as_secs()));
                continue;
            };
            let after = MonotonicClock.now().seconds_since(began);
            // A person's own time is not the arm's.
            if self.emulator.is_some() {
                self.figure(format!("reaction to {name}"), 1e3 * after, "ms", None);
            }
            self.person.tell(&format!("{name}: {what}"));
            if self.emulator.is_none() {
                self.person.tell(&format!("{undo} ({} s)", TIME.as_secs()));
            }
            self.ready = false;
            let undone = MonotonicClock.now();
            self.undo(TIME)?;
            if self.emulator.is_some() {
                self.figure(format!("recovery from {name}"), MonotonicClock.now().seconds_since(undone), "s", None);
            }
            seen.push(format!("{name}: {what}"));
        }
        self.stop()?;
        if seen.is_empty() {
            return skipped(format!("none was seen: {}", left_out.join(", ")));
        }
        let without = if left_out.is_empty() { String::new() } else { format!("; not: {}", left_out.join(", ")) };
        Ok(format!("{}{without}", seen.join("; ")))
    }

    /// Waits until the adapter notices something. Returns what.
    fn noticed(&mut self, limit: Duration) -> Result<Option<String>, End> {
        let end = MonotonicClock.now().after(limit);
        while MonotonicClock.now() < end {
            if let Err(error) = self.adapter.read_joints(&mut JointReading::default()) {
                return Ok(Some(error.to_string()));
            }
            match self.adapter.read_error() {
                Ok((0, _)) => {}
                Ok((code, text)) => return Ok(Some(format!("error {code}: {text}"))),
                Err(error) => return Ok(Some(error.to_string())),
            }
            if let Some(change) = self.adapter.foreign_change() {
                return Ok(Some(change.to_owned()));
            }
            if !self.adapter.read_enabled().unwrap_or(false) {
                return Ok(Some("motors off".to_owned()));
            }
            self.wait(Duration::from_millis(4))?;
        }
        Ok(None)
    }

    /// Waits until the arm can be enabled again.
    fn undo(&mut self, limit: Duration) -> Result<(), End> {
        let end = MonotonicClock.now().after(limit);
        loop {
            let result = self.clear().and_then(|()| self.prepare());
            match result {
                Err(End::Failed(_)) if MonotonicClock.now() < end => {
                    self.ready = false;
                    self.wait(Duration::from_millis(200))?;
                }
                result => return result,
            }
        }
    }
}
