//! `dimos replay LOG --verify`: reports whether a replay gives identical commands.

use std::path::Path;

use crate::blueprint::TaskTable;
use crate::cli::exit::Exit;
use crate::cli::log::progress;
use crate::cli::output;
use crate::replay::compare::Difference;
use crate::replay::recorded::RecordedError;
use crate::replay::verify::{Finding, Verification, verify_with};

/// Verifies a log and prints the result.
pub fn run(path: &Path, table: &TaskTable, json: bool) -> Result<Exit, RecordedError> {
    let found = verify_with(path, table, &mut progress::bar(false))?;
    if json {
        output::json(&found);
    } else {
        print(&found);
    }
    Ok(match found.finding {
        Finding::Reproducible => Exit::Ok,
        Finding::Different(_) => Exit::Failed,
        Finding::Incomplete { .. } => Exit::DATA_LOST,
    })
}

fn print(found: &Verification) {
    let Verification { ticks, requests, events, length, .. } = found;
    let ran = format!("{ticks} ticks ({length:.3} s, {requests} requests, {events} events)");
    match &found.finding {
        Finding::Reproducible => {
            let live = if found.live { "; live: verified up to its newest chunk" } else { "" };
            output::wrapped(format_args!("reproducible: {ran}, every command bit for bit{live}"));
        }
        Finding::Different(d) => {
            output::line(format_args!("different at tick {}, after {:.3} s: {}", d.tick, d.time, what(d)));
            output::line(format_args!("  in the log: {}", d.logged));
            output::line(format_args!("replayed:   {}", d.rerun));
            output::line(format_args!("before that: {ran} identical"));
            output::note("hint: the log was modified, or written by a program with other control code");
        }
        Finding::Incomplete { tick, why } => {
            output::line(format_args!("reproducible up to a gap: {ran}"));
            output::note(format_args!("warning: nothing can be verified from tick {tick} on: {why}"));
        }
    }
}

fn what(d: &Difference) -> String {
    match d.joint.as_ref().or(d.arm.as_ref()) {
        Some(of) => format!("{} of {of}", d.what),
        None => d.what.to_owned(),
    }
}
