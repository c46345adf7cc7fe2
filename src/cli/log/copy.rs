//! `dimos log cut` and `dimos log recover`: new logs from others.

use std::path::Path;

use serde_json::json;

use super::{Part, ended, progress, unreadable};
use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::output;
use dimos_log::rewrite::{Label, RewriteError, Written, copy};
use dimos_log::scan::Scan;

/// Writes a part of a log.
pub fn cut(path: &Path, part: &Part, to: &Path, json: bool) -> Result {
    let part = part.of(path)?;
    let mut scan = Scan::open_part(path, &[], part).map_err(unreadable)?.with_earlier();
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let label = Label { part_of: Some(&name), ..Label::default() };
    let written = copy(&mut scan, to, label, progress::of_scan(false)).map_err(|e| failure(e, to))?;
    Ok(print("cut", scan.loss().text().as_deref(), &written, to, json))
}

/// Writes what can be read of a log.
pub fn recover(path: &Path, to: Option<&Path>, json: bool) -> Result {
    let mut scan = Scan::open(path).map_err(unreadable)?;
    if scan.is_live() {
        let what = format!("{} is being written by a live run", path.display());
        return Err(Failure::usage(what).hint("end the run first; `dimos log cut` works meanwhile"));
    }
    let beside = path.with_file_name(format!("{}-recovered.mcap", path.file_stem().unwrap_or_default().display()));
    let to = to.unwrap_or(&beside);
    let written = copy(&mut scan, to, Label::default(), progress::of_scan(false)).map_err(|e| failure(e, to))?;
    Ok(print("recovered", scan.loss().text().as_deref(), &written, to, json))
}

/// Returns the failure of a copy; removes what there is of the new file.
pub fn failure(error: RewriteError, to: &Path) -> Failure {
    // A part of a file is of no use.
    if matches!(error, RewriteError::Write { exists: false, .. }) {
        let _ = std::fs::remove_file(to);
    }
    let exit = if matches!(error, RewriteError::Read(_)) { Exit::Usage } else { Exit::Failed };
    Failure::of(exit, error)
}

fn print(done: &str, loss: Option<&str>, written: &Written, to: &Path, as_json: bool) -> Exit {
    let length = written.span.map_or(0.0, |(start, end)| (end - start) as f64 * 1e-9);
    let messages = written.messages;
    if as_json {
        output::json(&json!({"file": to, "messages": messages, "length": length, "loss": loss}));
    } else {
        output::line(format_args!("{done}: {messages} messages, {length:.3} s: {}", to.display()));
    }
    ended(loss)
}
