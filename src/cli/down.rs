//! `dimos down`: shuts down a run like SIGTERM, or a planner that is attached to one.

use std::io::ErrorKind;
use std::net::{TcpStream, ToSocketAddrs};
use std::time::{Duration, Instant};

use serde_json::json;

use super::arguments::{connect, place};
use super::attach;
use super::exit::{Exit, Failure, Result};
use super::output;
use super::run_record::{RunRecord, RunState};
use dimos_rpc::api::{Shutdown, Status};
use dimos_rpc::client::{self, Client, ClientError};
use dimos_rpc::error::Code;
use dimos_rpc::run_dir::{LiveRun, RunDir};

/// Maximum wait for a controlled stop, with some margin; with an arm that parks.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(6);
const PARKING_TIMEOUT: Duration = Duration::from_secs(32);
/// Poll period.
const POLL_PERIOD: Duration = Duration::from_millis(20);

/// Arguments of `down`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Run to end, or planner in its own process; needed only when several runs are live
    #[arg(value_name = "RUN")]
    pub name: Option<String>,
    /// The same as the argument RUN
    #[arg(long, value_name = "RUN", conflicts_with = "name")]
    pub run: Option<String>,
    /// Print JSON, errors too
    #[arg(long)]
    pub json: bool,
}

/// Runs the verb: sends the request, waits until the run has ended, and prints the result.
pub fn run(args: &Args) -> Result {
    let folder = RunDir::standard();
    let name = args.name.as_deref().or(args.run.as_deref());
    if let Some(place) = place() {
        return elsewhere(args, place, name);
    }
    let found = match find(&folder, name) {
        Ok(found) => found,
        // A planner in its own process is not a run: only its name ends it.
        Err(failure) => {
            return match (name, attach::live()) {
                (Some(name), planners) => match planners.iter().find(|planner| planner.name == name) {
                    Some(planner) => attach::end(planner, args.json),
                    None => Err(failure),
                },
                (None, planners) if failure.exit != Exit::Usage && !planners.is_empty() => {
                    Err(only_planners(&planners))
                }
                (None, _) => Err(failure),
            };
        }
    };
    let connect = || Client::connect(&found.name, &found.socket);
    let (mut client, _) = Client::urgent(None, connect, &Shutdown {})?;
    let requested = Instant::now();
    // Afterwards, and over the same connection: a slow report delays no shutdown, and is that of the run that ends. One
    // that has ended already reports nothing.
    let status = client.call(Status {}).unwrap_or_default();
    let parks = status.arms.iter().any(|arm| arm.on_exit == "park");
    let timeout = if parks { PARKING_TIMEOUT } else { SHUTDOWN_TIMEOUT };
    // The name is free before the process has written its last lines.
    let recorded = || RunRecord::of(&found.name).filter(|record| record.pid == found.pid);
    let is_live = || recorded().is_some_and(|record| record.state() == RunState::Live);
    let is_found = |run: &LiveRun| run.name == found.name && run.pid == found.pid;
    while folder.runs().map_err(ClientError::from)?.iter().any(is_found) || is_live() {
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
            let planner = status.planner.and_then(|planner| planner.attached).map(|planner| planner.name);
            if args.json {
                let log = record.as_ref().and_then(|record| record.log.as_ref());
                output::json(&json!({"ended": found.name, "pid": found.pid, "log": log, "waiting_planner": planner}));
                return Ok(Exit::Ok);
            }
            output::note(format_args!("{} ended{log}", found.name));
            if let Some(name) = planner {
                output::note(format_args!("planner {name} waits for another run; to end it: dimos down {name}"));
            }
            Ok(Exit::Ok)
        }
    }
}

/// Shuts down a run on another computer, and waits until its gateway says that it has ended.
fn elsewhere(args: &Args, place: &str, name: Option<&str>) -> Result {
    let mut client = connect(name)?;
    let run = client.run().to_owned();
    client.call(Shutdown {})?;
    let requested = Instant::now();
    let mut status = client.call(Status {});
    let (log, pid) = status.as_ref().map_or((None, None), |status| (status.log.clone(), Some(status.pid)));
    let parks = status.as_ref().is_ok_and(|status| status.arms.iter().any(|arm| arm.on_exit == "park"));
    let timeout = if parks { PARKING_TIMEOUT } else { SHUTDOWN_TIMEOUT };
    while status.is_ok() {
        if requested.elapsed() > timeout {
            let what = format!("run {run} at {place} is still shutting down after {} s", timeout.as_secs());
            return Err(Failure::new(Exit::Failed, what).hint("its terminal or `dimos logs` there shows the reason"));
        }
        std::thread::sleep(POLL_PERIOD);
        status = client.call(Status {});
    }
    match status {
        Err(ClientError::Refused(refusal)) if refusal.code == Code::ShuttingDown => {}
        // The gateway ended, with the run, before it could answer.
        Err(_) if nothing_listens(place) => {}
        Err(error) => {
            let what = format!("run {run} at {place} is shutting down, and its end was not seen: {error}");
            return Err(Failure::new(Exit::Failed, what).hint(format!("dimos status --at {place}")));
        }
        Ok(_) => {}
    }
    if args.json {
        output::json(&json!({"ended": run, "pid": pid, "log": log, "at": place}));
        return Ok(Exit::Ok);
    }
    let log = log.map_or_else(String::new, |log| format!("; log on its computer: {log}"));
    output::note(format_args!("{run} at {place} ended{log}"));
    Ok(Exit::Ok)
}

/// Returns whether a computer answers that nothing listens at a place, `tcp/HOST:PORT`. A connection that is lost for
/// another reason gets no such answer.
fn nothing_listens(place: &str) -> bool {
    let address = place.split_once('/').map_or(place, |(_, address)| address);
    let addresses: Vec<_> = address.to_socket_addrs().into_iter().flatten().collect();
    let refuses = |address| {
        let tried = TcpStream::connect_timeout(address, Duration::from_secs(1));
        tried.is_err_and(|error| error.kind() == ErrorKind::ConnectionRefused)
    };
    !addresses.is_empty() && addresses.iter().all(refuses)
}

/// Returns the failure of `down` without a name where only planners are left.
fn only_planners(planners: &[LiveRun]) -> Failure {
    let names: Vec<&str> = planners.iter().map(|planner| planner.name.as_str()).collect();
    let what = format!("no run is live; planners wait for one: {}", names.join(", "));
    let hint = names.iter().map(|name| format!("dimos down {name}")).collect::<Vec<_>>().join("; ");
    Failure::new(Exit::Failed, what).hint(hint)
}

/// Returns the selected run; for one that has ended, its failure.
fn find(folder: &RunDir, name: Option<&str>) -> Result<LiveRun> {
    client::find(folder, name).map_err(|error| {
        let dead = name.and_then(RunRecord::failure_of);
        dead.unwrap_or_else(|| error.into())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_port_that_was_closed_refuses() {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let place = format!("tcp/{}", listener.local_addr().unwrap());
        assert!(!nothing_listens(&place));
        drop(listener);
        assert!(nothing_listens(&place));
        assert!(!nothing_listens("tcp/no port") && !nothing_listens(""));
    }
}
