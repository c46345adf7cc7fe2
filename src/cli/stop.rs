//! `dimos stop`: a latched hold at once. An operational stop, not a safety function.

use std::collections::BTreeMap;

use super::arguments::Target;
use super::exit::{Exit, Failure};
use super::other_users;
use super::output::{self, Table, Tone, toned};
use crate::rpc::Code;
use crate::rpc::api::{Confirmation, Stop, StopReply};
use crate::rpc::client::{Client, ClientError};
use crate::rpc::run_dir::LiveRun;

/// Arguments of `stop`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Stops every arm of every live run of this user, unless ARM or --run narrows it.
The arms stay powered and held; no task moves them until `dimos arm reset ARM` and `dimos arm enable ARM`.
Exit code 0 only if every arm confirmed. This is an operational stop, not a safety function.")]
pub struct Args {
    /// Stop only the arm with this hardware_id, in every run that has it
    pub arm: Option<String>,
    /// Stop all arms of all runs (the default)
    #[arg(long, conflicts_with = "arm")]
    pub all: bool,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

type Result<T = Exit, E = Failure> = std::result::Result<T, E>;

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let runs = args.target_run.named_or_all()?;
    // A run that does not answer must not delay the stop of the others.
    let replies: Vec<(&LiveRun, Result<StopReply, ClientError>)> = std::thread::scope(|scope| {
        let asked: Vec<_> = runs.iter().map(|run| (run, scope.spawn(|| stop(run, args)))).collect();
        asked.into_iter().filter_map(|(run, answer)| Some((run, answer.join().ok()?))).collect()
    });
    let done: BTreeMap<&str, &StopReply> =
        replies.iter().filter_map(|(run, r)| r.as_ref().ok().map(|r| (run.name.as_str(), r))).collect();
    if args.target_run.json {
        output::json(&done);
    } else if !done.is_empty() {
        print(&done);
    }
    if args.target_run.run.is_none() {
        for other in other_users::runs() {
            output::note(format_args!("not stopped: run {other}; only that user can stop it"));
        }
    }
    if runs.is_empty() {
        return Err(ClientError::NoRun.into());
    }
    let confirmed = done.values().flat_map(|r| r.arms.values()).all(|c| *c == Confirmation::Confirmed);
    let stopped_any = !done.is_empty();
    // A run without the arm is not a failure as long as another one has it.
    let is_elsewhere = |e: &ClientError| matches!(e, ClientError::Refused(e) if e.code == Code::UnknownArm);
    let failures = replies.into_iter().filter_map(|(_, reply)| reply.err());
    let mut failures = failures.filter(|e| !(stopped_any && is_elsewhere(e))).map(Failure::from);
    if let Some(first) = failures.next() {
        failures.filter(|failure| *failure != first).for_each(|failure| output::failure(&failure));
        return Err(first);
    }
    if !confirmed {
        let what = "not every arm confirmed its stop";
        return Err(Failure::new(Exit::Failed, what).hint("watch the arm; `dimos state` shows whether it is moving"));
    }
    Ok(Exit::Ok)
}

fn stop(run: &LiveRun, args: &Args) -> Result<StopReply, ClientError> {
    Client::connect(&run.name, &run.socket)?.call(Stop { arm: args.arm.clone() })
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
