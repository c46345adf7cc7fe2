//! `dimos down`: ends a run exactly like SIGTERM, or a planner that attached to one.

use std::time::{Duration, Instant};

use super::attach;
use super::exit::{Exit, Failure, Result};
use super::output;
use super::run_record::{Fate, RunRecord};
use crate::rpc::api::Shutdown;
use crate::rpc::client::{self, Client, ClientError};
use crate::rpc::place::{LiveRun, RunFolder};

/// How long a controlled end may take, and a little.
const PATIENCE: Duration = Duration::from_secs(6);
/// How often to look.
const INTERVAL: Duration = Duration::from_millis(20);

/// Arguments of `down`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The run to end, or the planner that attached to one; needed only when several runs are live
    pub name: Option<String>,
    /// The same
    #[arg(long, value_name = "NAME", conflicts_with = "name")]
    pub run: Option<String>,
}

/// Runs the verb: asks, waits until the run is gone, and says what became of it.
pub fn run(args: &Args) -> Result {
    let folder = RunFolder::standard();
    let name = args.name.as_deref().or(args.run.as_deref());
    let found = match find(&folder, name) {
        Ok(found) => found,
        // A planner in a process of its own is no run, but has a name as well.
        Err(failure) => return attach::find(name).map_or(Err(failure), |planner| attach::end(&planner)),
    };
    Client::connect(&found.name, &found.socket)?.call(Shutdown {})?;
    let asked = Instant::now();
    // The name is free before the process has written its last words.
    let noted = || RunRecord::of(&found.name).filter(|record| record.pid == found.pid);
    let lives = || noted().is_some_and(|record| record.fate() == Fate::Lives);
    while folder.runs().map_err(ClientError::from)?.contains(&found) || lives() {
        if asked.elapsed() > PATIENCE {
            let what = format!("{} was asked to end, but pid {} still lives", found.name, found.pid);
            return Err(
                Failure::new(Exit::Failed, what).hint("its own terminal or `dimos logs` says what it waits for")
            );
        }
        std::thread::sleep(INTERVAL);
    }
    match noted() {
        Some(record) if record.fell() => {
            let exit = if let Fate::Ended(end) = record.fate() { Exit::of(end.exit) } else { Exit::Failed };
            Err(Failure { exit, ..record.failure().unwrap_or_else(|| Failure::new(exit, "it fell")) })
        }
        Some(RunRecord { log: Some(log), .. }) => {
            output::note(format_args!("{} ended; its log: {}", found.name, log.display()));
            Ok(Exit::Ok)
        }
        _ => {
            output::note(format_args!("{} ended", found.name));
            Ok(Exit::Ok)
        }
    }
}

/// The run that is meant. One that is named, but dead: what became of it.
fn find(folder: &RunFolder, name: Option<&str>) -> Result<LiveRun> {
    client::find(folder, name).map_err(|error| {
        let dead = name.and_then(RunRecord::of).and_then(|record| record.failure());
        dead.unwrap_or_else(|| error.into())
    })
}
