//! `dimos replay LOG --verify`: says whether a log came out the same when it was run again.

use std::path::Path;

use super::{DATA_LOST, DIFFERENT};
use crate::cli::output;
use crate::control::task_spec::TaskTable;
use crate::replay::compare::Difference;
use crate::replay::recorded::RecordedError;
use crate::replay::verify::{Finding, Verification, verify};

/// Verifies a log and prints what was found. Gives the exit code.
pub fn run(path: &Path, table: &TaskTable, json: bool) -> Result<u8, RecordedError> {
    let found = verify(path, table)?;
    if json {
        output::json(&found);
    } else {
        print(&found);
    }
    Ok(match found.finding {
        Finding::Reproducible => 0,
        Finding::Different(_) => DIFFERENT,
        Finding::Incomplete { .. } => DATA_LOST,
    })
}

fn print(found: &Verification) {
    let Verification { ticks, requests, events, length, .. } = found;
    let ran = format!("{ticks} ticks ({length:.3} s, {requests} requests, {events} events)");
    match &found.finding {
        Finding::Reproducible => output::line(format_args!("reproducible: {ran}, every command bit for bit")),
        Finding::Different(d) => {
            output::line(format_args!("different at tick {}, after {:.3} s: {}", d.tick, d.time, what(d)));
            output::line(format_args!("  in the log: {}", d.logged));
            output::line(format_args!("  run again:  {}", d.rerun));
            output::line(format_args!("before that: {ran} came out the same"));
            output::note("hint: the log was changed, or a program that computes otherwise wrote it");
        }
        Finding::Incomplete { tick, why } => {
            output::line(format_args!("reproducible up to a gap: {ran}"));
            output::note(format_args!("warning: from tick {tick} on nothing can be verified: {why}"));
        }
    }
}

fn what(d: &Difference) -> String {
    match d.joint.as_ref().or(d.arm.as_ref()) {
        Some(of) => format!("{} of {of}", d.what),
        None => d.what.to_owned(),
    }
}
