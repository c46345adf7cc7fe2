//! `dimos log list`: the logs of runs.

use serde_json::json;

use super::info::{arms, faults, length, state};
use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::output::{self, Table, span};
use dimos_log::disk_space::Megabytes;
use dimos_log::files;
use dimos_log::replay::LogReader;

/// Largest log that is read whole [bytes]: a list is to be quick. Whether chunks of a larger one are damaged is not
/// known: it is `closed`.
const READ_WHOLE: u64 = 32 << 20;

/// Prints the logs, the newest first.
pub fn run(json: bool) -> Result {
    let Some(folder) = files::log_folder() else {
        return Err(Failure::usage("no folder for logs: neither XDG_STATE_HOME nor HOME is set"));
    };
    let logs = files::all(&folder).map_err(|e| Failure::of(Exit::Failed, format!("{}: {e}", folder.display())))?;
    // The name of a log in that folder has the time of its start.
    let (mut table, mut all) = (Table::new(&["LOG", ">?LENGTH", ">?SIZE", "STATE", ">?FAULTS", "?ARMS"]), Vec::new());
    for path in logs.iter().rev() {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let size = files::size(path);
        let is_read = size <= READ_WHOLE;
        let read = LogReader::open(path).and_then(|log| Ok((faults(path, log.info(), is_read)?, log.info().clone())));
        let Ok(((faults, loss), info)) = read else {
            all.push(json!({"path": path, "size": size, "state": "unreadable"}));
            let size = Megabytes(size).to_string();
            table.row([name, "-".into(), size, "unreadable".into(), "-".into(), "-".into()]);
            continue;
        };
        let (run, arms) = (info.metadata.get("run"), arms(&info).unwrap_or_default());
        let state = match state(&info, loss.is_some()) {
            "complete" if !is_read => "closed",
            state => state,
        };
        let faults = faults.len();
        all.push(json!({
            "path": path, "run": run, "start": info.span.map(|(start, _)| start), "length": length(&info), "size": size,
            "arms": arms, "state": state, "loss": loss, "faults": faults,
        }));
        let (length, size) = (span(length(&info)), Megabytes(size).to_string());
        table.row([name, length, size, state.into(), faults.to_string(), arms.join(", ")]);
    }
    if json {
        output::json(&all);
    } else if all.is_empty() {
        output::note(format_args!("no logs in {}", folder.display()));
    } else {
        table.print();
    }
    Ok(Exit::Ok)
}
