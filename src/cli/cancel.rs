//! `dimos cancel`: ends motions by decelerating within limits.

use super::arguments::Target;
use super::exit::{Exit, Result};
use super::output;
use crate::rpc::api::Cancel;

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
    let mut client = args.target_run.connect()?;
    let reply = client.call(Cancel { arm: args.arm.clone(), task: args.task.clone(), plan: None })?;
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
    Ok(Exit::Ok)
}
