//! `dimos stop`: a latched hold at once. An operational stop, not a safety function.

use std::collections::BTreeMap;

use super::arguments::Target;
use super::exit::{Exit, Failure, Result};
use super::output::{self, Table, Tone, toned};
use crate::rpc::api::{Confirmation, Stop, StopReply};
use crate::rpc::client::{Client, ClientError};
use crate::rpc::place::{LiveRun, RunFolder};

/// Arguments of `stop`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
The arms stay powered and held; no task moves them until `dimos arm reset ARM` and `dimos arm enable ARM`.
Exit code 0 only when every arm confirmed. This is an operational stop and no safety function.")]
pub struct Args {
    /// Stop this arm only
    pub arm: Option<String>,
    /// Stop all arms (the default), of all live runs where none is named
    #[arg(long, conflicts_with = "arm")]
    pub all: bool,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let runs = if args.all && args.target_run.run.is_none() {
        args.target_run.named_or_all()?
    } else {
        vec![crate::rpc::client::find(&RunFolder::standard(), args.target_run.run.as_deref())?]
    };
    if runs.is_empty() {
        return Err(ClientError::NoRun.into());
    }
    // One run that does not answer must not keep the others moving.
    let replies: Vec<(&LiveRun, Result<StopReply>)> = runs.iter().map(|run| (run, stop(run, args))).collect();
    let done: BTreeMap<&str, &StopReply> =
        replies.iter().filter_map(|(run, r)| r.as_ref().ok().map(|r| (run.name.as_str(), r))).collect();
    if args.target_run.json {
        output::json(&done);
    } else if !done.is_empty() {
        print(&done);
    }
    let confirmed = done.values().flat_map(|r| r.arms.values()).all(|c| *c == Confirmation::Confirmed);
    let mut failures = replies.into_iter().filter_map(|(_, reply)| reply.err());
    if let Some(first) = failures.next() {
        failures.for_each(|failure| output::failure(&failure));
        return Err(first);
    }
    if !confirmed {
        let what = "not every arm confirmed that it stops";
        return Err(Failure::new(Exit::Failed, what).hint("watch the arm; `dimos state` shows whether it moves"));
    }
    Ok(Exit::Ok)
}

fn stop(run: &LiveRun, args: &Args) -> Result<StopReply> {
    let mut client = Client::connect(&run.name, &run.socket)?;
    Ok(client.call(Stop { arm: args.arm.clone() })?)
}

fn print(done: &BTreeMap<&str, &StopReply>) {
    let mut table = Table::new(&["RUN", "ARM", "STOP"]);
    for (run, reply) in done {
        for (arm, confirmation) in &reply.arms {
            let tone = match confirmation {
                Confirmation::Confirmed => Tone::Good,
                Confirmation::SentNotConfirmed => Tone::Warning,
                Confirmation::NotSent => Tone::Bad,
            };
            table.row([(*run).into(), arm.as_str().into(), toned(confirmation.text(), tone)]);
        }
    }
    table.print();
}
