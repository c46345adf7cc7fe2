//! `dimos down`: shuts down a run like SIGTERM, or a planner that is attached to one.

use std::time::{Duration, Instant};

use super::attach;
use super::exit::{Exit, Failure, Result};
use super::output;
use super::run_record::{RunRecord, RunState};
use crate::rpc::api::{Shutdown, Status};
use crate::rpc::client::{self, Client, ClientError};
use crate::rpc::run_dir::{LiveRun, RunDir};

/// Maximum wait for a controlled stop, with some margin; with an arm that parks.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(6);
const PARKING_TIMEOUT: Duration = Duration::from_secs(32);
/// Poll period.
const POLL_PERIOD: Duration = Duration::from_millis(20);

/// Arguments of `down`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Run to end, or the planner attached to one; needed only when several runs are live
    pub name: Option<String>,
    /// Run to end (same as the positional NAME)
    #[arg(long, value_name = "NAME", conflicts_with = "name")]
    pub run: Option<String>,
}

/// Runs the verb: sends the request, waits until the run has ended, and prints the result.
pub fn run(args: &Args) -> Result {
    let folder = RunDir::standard();
    let name = args.name.as_deref().or(args.run.as_deref());
    let found = match find(&folder, name) {
        Ok(found) => found,
        // A planner in its own process is not a run. Without a name it is ended only if no run is live.
        Err(failure) => {
            let planner = attach::find(name).filter(|_| name.is_some() || failure.exit != Exit::Usage);
            return planner.map_or(Err(failure), |planner| attach::end(&planner));
        }
    };
    let mut client = Client::connect(&found.name, &found.socket)?;
    client.call(Shutdown {})?;
    let requested = Instant::now();
    // Afterwards, and over the same connection: a slow report delays no shutdown, and is that of the run that ends. One
    // that has ended already reports nothing.
    let parks = client.call(Status {}).is_ok_and(|status| status.arms.iter().any(|arm| arm.on_exit == "park"));
    let timeout = if parks { PARKING_TIMEOUT } else { SHUTDOWN_TIMEOUT };
    // The name is free before the process has written its last lines.
    let recorded = || RunRecord::of(&found.name).filter(|record| record.pid == found.pid);
    let is_live = || recorded().is_some_and(|record| record.state() == RunState::Live);
    while folder.runs().map_err(ClientError::from)?.contains(&found) || is_live() {
        if requested.elapsed() > timeout {
            let what = format!("{} is still shutting down: pid {} has not exited", found.name, found.pid);
            return Err(Failure::new(Exit::Failed, what).hint("its terminal or `dimos logs` shows the reason"));
        }
        std::thread::sleep(POLL_PERIOD);
    }
    match recorded() {
        Some(record) if record.ended_abnormally() => {
            let exit = if let RunState::Ended(end) = record.state() { Exit::of(end.exit) } else { Exit::Failed };
            Err(Failure { exit, ..record.failure().unwrap_or_else(|| Failure::new(exit, "it ended abnormally")) })
        }
        record => {
            let end = record.as_ref().and_then(|record| record.end.as_ref());
            for warning in end.into_iter().flat_map(|end| &end.warnings) {
                output::note(format_args!("warning: {warning}"));
            }
            let log = record.as_ref().and_then(|record| record.log.as_ref());
            let log = log.map_or_else(String::new, |log| format!("; log: {}", log.display()));
            output::note(format_args!("{} ended{log}", found.name));
            Ok(Exit::Ok)
        }
    }
}

/// Returns the selected run; for one that has ended, its failure.
fn find(folder: &RunDir, name: Option<&str>) -> Result<LiveRun> {
    client::find(folder, name).map_err(|error| {
        let dead = name.and_then(RunRecord::of).and_then(|record| record.failure());
        dead.unwrap_or_else(|| error.into())
    })
}
