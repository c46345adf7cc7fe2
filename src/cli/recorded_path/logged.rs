//! The positions of some joints in the joint states of a log, in order of time. Refuses what is not the whole motion of
//! one publisher: half of a motion, or one that jumps, is never followed.

use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::path::Path;

use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::log::{STATES, no_states};
use crate::cli::output;
use crate::planning::path::unwind;
use crate::recording::joints::Places;
use crate::recording::messages::JointState;
use crate::recording::replay::{LogReader, Payload, ReplayError, Selection};
use crate::replay::motion::MAX_GAP;

/// A larger step between two states is checked [rad].
const MIN_STEP: f64 = 0.05;
/// No joint of an arm is faster [rad/s].
const MAX_SPEED: f64 = 20.0;

/// Reads the positions of these joints. Those of joints that are continuous (`turns`) have no steps of whole turns.
pub fn read(file: &Path, joints: &[String], turns: &[bool], tolerance: f64) -> Result<Vec<Vec<f64>>> {
    let unreadable = |e: ReplayError| Failure::of(Exit::Usage, e);
    let mut log = LogReader::open(file).map_err(unreadable)?;
    log.select(Selection { topics: vec![STATES.to_owned()], ..Selection::default() }).map_err(unreadable)?;
    let began = log.info().span.map_or(0, |(start, _)| start);
    let mut states = States {
        joints,
        turns,
        tolerance,
        began,
        places: Places::new(joints),
        last: None,
        rows: Vec::new(),
        others: BTreeMap::new(),
    };
    loop {
        match log.next_entry() {
            Ok(Some(entry)) => match entry.data {
                Payload::JointState(state) => states.take(file, entry.log_time, &state)?,
                Payload::Damaged { error, .. } => return Err(lost(file, &error, entry.log_time, began)),
                _ => {}
            },
            Ok(None) => break,
            Err(ReplayError::Damaged { damage }) => {
                let at = damage.span.map_or(began, |(start, _)| start);
                return Err(lost(file, &damage.to_string(), at, began));
            }
            Err(ReplayError::Cut { at, reason, .. }) => {
                let last = states.last.as_ref().map_or(began, |last| last.time);
                return Err(lost(file, &format!("it ends at byte {at}: {reason}"), last, began));
            }
            Err(e) => return Err(unreadable(e)),
        }
    }
    states.finish(file, &log)
}

/// Returns the failure of a log that lacks a part of the motion from a time on [ns].
fn lost(file: &Path, why: &str, at: u64, began: u64) -> Failure {
    let path = file.display();
    let before = at.saturating_sub(began) as f64 * 1e-9;
    let what =
        format!("{path}: a part of the motion is missing or wrong from {before:.3} s on: {why}; nothing has moved");
    // Rounded down: what is damaged is not in the part.
    let until = ((before - 1e-3) * 100.0).floor() / 100.0;
    let hint = match until > 0.0 {
        true => format!("take the part before: dimos log cut {path} --to {until} -o part.mcap"),
        false => format!("`dimos log recover {path}` writes what can be read to a new file"),
    };
    Failure::new(Exit::Log, what).hint(hint)
}

/// The latest state with all joints.
struct State {
    /// Unix time of the message, and in it [ns].
    time: u64,
    stamp: i64,
    positions: Vec<f64>,
}

struct States<'a> {
    joints: &'a [String],
    turns: &'a [bool],
    tolerance: f64,
    began: u64,
    places: Places,
    last: Option<State>,
    rows: Vec<Vec<f64>>,
    /// Names in messages that lack a joint, and how many have them.
    others: BTreeMap<Vec<String>, u64>,
}

impl States<'_> {
    fn take(&mut self, file: &Path, time: u64, state: &JointState) -> Result<()> {
        let mut positions: Vec<f64> = self.places.pick(&state.name, &state.position).collect();
        if positions.is_empty() || positions.iter().any(|q| !q.is_finite()) {
            *self.others.entry(state.name.clone()).or_default() += 1;
            return Ok(());
        }
        let at = &state.header.stamp;
        let stamp = i64::from(at.sec) * 1_000_000_000 + i64::from(at.nanosec);
        if let Some(last) = &self.last {
            unwind(&mut positions, &last.positions, self.turns);
            let now = State { time, stamp, positions: positions.clone() };
            self.check_step(last, &now)
                .map_err(|failure| Failure { what: format!("{}: {}", file.display(), failure.what), ..failure })?;
        }
        // At rest all rows are the same.
        if self.rows.last() != Some(&positions) {
            self.rows.push(positions.clone());
        }
        self.last = Some(State { time, stamp, positions });
        Ok(())
    }

    /// Refuses a step that no arm makes, and one that was not recorded.
    fn check_step(&self, last: &State, now: &State) -> Result<()> {
        let logged = now.time.saturating_sub(last.time) as f64 * 1e-9;
        let measured = now.stamp.saturating_sub(last.stamp) as f64 * 1e-9;
        let seconds = logged.max(measured);
        let at = last.time.saturating_sub(self.began) as f64 * 1e-9;
        let steps = self.joints.iter().zip(last.positions.iter().zip(&now.positions));
        for (joint, (from, to)) in steps {
            let step = (to - from).abs();
            let jump = format!("at {at:.3} s {joint} goes from {from:.4} to {to:.4} rad");
            if step > MIN_STEP && step > MAX_SPEED * seconds {
                let (within, publishers) = (seconds * 1e3, format!("two publishers write {STATES}"));
                let turned = (step - TAU).abs() < MIN_STEP;
                let (why, hint) = match turned {
                    true => ("a whole turn".to_owned(), "only a planner follows joints that turn without limits"),
                    false => (publishers, "record the states of one of them only"),
                };
                return Err(Failure::usage(format!("{jump} within {within:.0} ms: {why}")).hint(hint));
            }
            if step > self.tolerance && logged > MAX_GAP {
                let what = format!("{jump} while nothing was recorded for {logged:.1} s; nothing has moved");
                let hint = "take the part before or after: dimos log cut LOG --to TIME -o part.mcap";
                return Err(Failure::new(Exit::Log, what).hint(hint));
            }
        }
        Ok(())
    }

    fn finish(self, file: &Path, log: &LogReader) -> Result<Vec<Vec<f64>>> {
        let path = file.display();
        let list = |names: &[String]| names.join(", ");
        if self.rows.is_empty() {
            let wanted = list(self.joints);
            let Some((most, _)) = self.others.iter().max_by_key(|(_, count)| **count) else {
                return Err(no_states(file, log.info()));
            };
            let what = format!("{path}: no message has all joints ({wanted}); it has {}", list(most));
            return Err(Failure::usage(what).hint("joints are matched by name, as `dimos state` shows them"));
        }
        for (names, count) in &self.others {
            output::note(format_args!("{path}: left out {count} messages of {}", list(names)));
        }
        Ok(self.rows)
    }
}
