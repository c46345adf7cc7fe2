//! `dimos log list`: the logs of runs.

use serde_json::json;

use super::info::{arms, faults, length, state};
use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::output::{self, Table, span};
use crate::recording::disk_space::Megabytes;
use crate::recording::files;
use crate::recording::replay::LogReader;

/// Prints the logs, the newest first.
pub fn run(json: bool) -> Result {
    let Some(folder) = files::log_folder() else {
        return Err(Failure::usage("no folder for logs: neither XDG_STATE_HOME nor HOME is set"));
    };
    let logs = files::all(&folder).map_err(|e| Failure::of(Exit::Failed, format!("{}: {e}", folder.display())))?;
    // The name of a log in that folder has the time of its start.
    let (mut table, mut all) = (Table::new(&["LOG", ">LENGTH", ">SIZE", "STATE", ">FAULTS", "~ARMS"]), Vec::new());
    for path in logs.iter().rev() {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let size = files::size(path);
        let read = LogReader::open(path).and_then(|log| Ok((faults(path, log.info())?.len(), log.info().clone())));
        let Ok((faults, info)) = read else {
            all.push(json!({"path": path, "size": size, "state": "unreadable"}));
            let size = Megabytes(size).to_string();
            table.row([name, "-".into(), size, "unreadable".into(), "-".into(), "-".into()]);
            continue;
        };
        let (run, arms) = (info.metadata.get("run"), arms(&info).unwrap_or_default());
        all.push(json!({
            "path": path, "run": run, "start": info.span.map(|(start, _)| start), "length": length(&info), "size": size,
            "arms": arms, "state": state(&info), "faults": faults,
        }));
        let (length, size) = (span(length(&info)), Megabytes(size).to_string());
        table.row([name, length, size, state(&info).into(), faults.to_string(), arms.join(", ")]);
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
