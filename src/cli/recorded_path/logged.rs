//! The positions of some joints in the joint states of a log, in order of time. Refuses what is not the whole motion of
//! one publisher: half of a motion, or one that jumps, is never followed.

use std::collections::BTreeMap;
use std::path::Path;

use super::steps::{Recording, Steps};
use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::log::{STATES, no_states};
use crate::cli::output;
use crate::offline::unwind;
use crate::replay::motion::MAX_GAP;
use dimos_log::joints::{Places, twice};
use dimos_log::messages::JointState;
use dimos_log::replay::{LogReader, Payload, ReplayError, Selection};

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
        steps: Steps::new(joints, Recording::Topic(STATES)),
        publishers: Vec::new(),
        last: None,
        rows: Vec::new(),
        others: BTreeMap::new(),
    };
    loop {
        match log.next_entry() {
            Ok(Some(entry)) => match entry.data {
                Payload::JointState(state) => states
                    .take(entry.log_time, entry.publisher, &state)
                    .map_err(|failure| Failure { what: format!("{}: {}", file.display(), failure.what), ..failure })?,
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
    let rows = states.finish(file, &log)?;
    // What is missing without a damaged place: the summary counts more messages.
    log.loss().text().map_or(Ok(rows), |why| Err(lost(file, &why, began, began)))
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
    steps: Steps<'a>,
    /// Publishers of states with all joints, the latest one last.
    publishers: Vec<u16>,
    last: Option<State>,
    rows: Vec<Vec<f64>>,
    /// Names in messages that lack a joint, and how many have them.
    others: BTreeMap<Vec<String>, u64>,
}

impl States<'_> {
    fn take(&mut self, time: u64, publisher: u16, state: &JointState) -> Result<()> {
        if let Some(joint) = twice(&state.name).filter(|joint| self.joints.contains(joint)) {
            let what = format!("at {:.3} s a message has {joint} twice", self.seconds(time));
            return Err(Failure::usage(what).hint("which of its positions is right is unknown: record each joint once"));
        }
        let mut positions: Vec<f64> = self.places.pick(&state.name, &state.position).collect();
        if positions.is_empty() || positions.iter().any(|q| !q.is_finite()) {
            *self.others.entry(state.name.clone()).or_default() += 1;
            return Ok(());
        }
        let at = &state.header.stamp;
        let stamp = i64::from(at.sec) * 1_000_000_000 + i64::from(at.nanosec);
        if let Some(last) = self.last.take() {
            unwind(&mut positions, &last.positions, self.turns);
            let now = State { time, stamp, positions: positions.clone() };
            self.check_step(&last, &now)?;
        }
        self.check_publisher(time, publisher)?;
        // At rest all rows are the same.
        if self.rows.last() != Some(&positions) {
            self.rows.push(positions.clone());
        }
        self.last = Some(State { time, stamp, positions });
        Ok(())
    }

    /// Returns the time since the log began [s].
    fn seconds(&self, time: u64) -> f64 {
        time.saturating_sub(self.began) as f64 * 1e-9
    }

    /// Refuses a step that no arm makes, and one that was not recorded.
    fn check_step(&mut self, last: &State, now: &State) -> Result<()> {
        let logged = now.time.saturating_sub(last.time) as f64 * 1e-9;
        let measured = now.stamp.saturating_sub(last.stamp) as f64 * 1e-9;
        let at = self.seconds(last.time);
        self.steps.check(at, logged.max(measured), &last.positions, &now.positions)?;
        let mut steps = self.joints.iter().zip(last.positions.iter().zip(&now.positions));
        if logged > MAX_GAP
            && let Some((joint, (from, to))) = steps.find(|(_, (from, to))| (*to - *from).abs() > self.tolerance)
        {
            let jump = format!("at {at:.3} s {joint} goes from {from:.4} to {to:.4} rad");
            let what = format!("{jump} while nothing was recorded for {logged:.1} s; nothing has moved");
            let hint = "take the part before or after: dimos log cut LOG --to TIME -o part.mcap";
            return Err(Failure::new(Exit::Log, what).hint(hint));
        }
        Ok(())
    }

    /// Refuses a publisher that continues after another one: a driver that was restarted does not come back.
    fn check_publisher(&mut self, time: u64, publisher: u16) -> Result<()> {
        if self.publishers.last() == Some(&publisher) {
            return Ok(());
        }
        if self.publishers.contains(&publisher) {
            let what = format!("at {:.3} s two publishers write {STATES} in turn", self.seconds(time));
            return Err(Failure::usage(what).hint("record the states of one of them only"));
        }
        self.publishers.push(publisher);
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
