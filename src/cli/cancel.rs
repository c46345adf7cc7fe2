//! `dimos cancel`: ends motions by decelerating within limits.

use std::time::Duration;

use super::arguments::{Target, connect};
use super::exit::{Exit, Result};
use super::output;
use dimos_rpc::api::{Cancel, Status};
use dimos_rpc::client::Client;
use dimos_rpc::report::TaskReport;

/// Time in which a client that streams sends its next targets.
const STREAM_PERIOD: Duration = Duration::from_millis(250);

/// Arguments of `cancel`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Cancel motions of this arm only
    pub arm: Option<String>,
    /// Cancel the motion of this task only
    #[arg(long, conflicts_with = "arm")]
    pub task: Option<String>,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let cancel = Cancel { arm: args.arm.clone(), task: args.task.clone(), ..Cancel::default() };
    let (mut client, reply) = Client::urgent(None, || connect(args.target_run.run.as_deref()), &cancel)?;
    if args.target_run.json {
        output::json(&reply);
        return Ok(Exit::Ok);
    }
    for (task, status) in &reply.tasks {
        output::line(format_args!("{task}: {status}"));
    }
    if reply.planning {
        output::line("planning: CANCELLED");
    }
    if reply.tasks.is_empty() && !reply.planning {
        output::note("nothing was moving");
    }
    // A stream continues with the next target of its client.
    let was_stream = |task: &TaskReport| {
        reply.tasks.get(&task.name).is_some_and(|status| status == "CANCELLED") && !task.takes("execute")
    };
    let tasks = client.call(Status {})?.tasks;
    if tasks.iter().any(was_stream) {
        std::thread::sleep(STREAM_PERIOD);
        let tasks = client.call(Status {})?.tasks;
        for task in tasks.iter().filter(|task| was_stream(task) && task.state == "EXECUTING") {
            let name = &task.name;
            output::note(format_args!("{name} executes again: a client sends it targets; `dimos stop` holds the arm"));
        }
    }
    Ok(Exit::Ok)
}
