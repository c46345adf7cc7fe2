//! `dimos stop`: a latched hold at once. An operational stop, not a safety function.

use std::collections::BTreeMap;
use std::io::ErrorKind;

use super::arguments::{self, Target, connect_to};
use super::exit::{Exit, Failure};
use super::other_users;
use super::output::{self, Table, Tone, toned};
use dimos_rpc::api::{Confirmation, Stop, StopReply};
use dimos_rpc::client::{self, Client, ClientError, find};
use dimos_rpc::run_dir::{LiveRun, RunDir};
use dimos_rpc::{Code, RpcError};

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
    #[arg(long, conflicts_with = "arm", hide = true)]
    pub all: bool,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

type Result<T = Exit, E = Failure> = std::result::Result<T, E>;
type Replies<'a> = Vec<(&'a LiveRun, Result<StopReply, ClientError>)>;

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let (runs, unreached) = runs(args)?;
    let replies = of_each(&runs, |run| stop(run, args));
    let done: BTreeMap<&str, &StopReply> =
        replies.iter().filter_map(|(run, r)| r.as_ref().ok().map(|r| (run.name.as_str(), r))).collect();
    match (done.is_empty(), args.target_run.json) {
        // Only the error is printed: one object in all.
        (true, _) => {}
        (false, true) => output::json(&done),
        (false, false) => print(&done),
    }
    if args.target_run.run.is_none() && !arguments::is_place_given() {
        for other in other_users::runs() {
            output::note(format_args!("not stopped: run {other}; only that user can stop it"));
        }
        other_users::note_unseen(runs.is_empty());
    }
    if runs.is_empty() {
        return Err(unreached.unwrap_or_else(|| ClientError::NoRun.into()));
    }
    let result = result(replies);
    match (result, unreached) {
        (Ok(_), Some(unreached)) => Err(Failure { exit: Exit::Failed, ..unreached }),
        (Err(failure), Some(unreached)) => {
            output::failure(&unreached);
            Err(failure)
        }
        (result, None) => result,
    }
}

/// Returns the runs to stop, and why a place was not reached. Without `--at`: those of this computer, and those of
/// `DIMOS_AT`.
fn runs(args: &Args) -> Result<(Vec<LiveRun>, Option<Failure>)> {
    if arguments::place().is_none() || arguments::is_place_given() {
        return Ok((args.target_run.named_or_all()?, None));
    }
    let folder = RunDir::standard();
    let here = match &args.target_run.run {
        Some(name) => Ok(find(&folder, Some(name)).into_iter().collect()),
        None => folder.runs(),
    };
    let mut runs: Vec<LiveRun> = match here {
        Ok(runs) => runs,
        // The runs of the place are stopped all the same.
        Err(error) => return Ok((args.target_run.named_or_all()?, Some(ClientError::from(error).into()))),
    };
    match args.target_run.named_or_all() {
        Ok(remote) => {
            runs.extend(remote);
            Ok((runs, None))
        }
        // The run may be here.
        Err(failure) if failure.exit == Exit::Usage && !runs.is_empty() => Ok((runs, None)),
        Err(failure) => Ok((runs, Some(failure))),
    }
}

/// Returns the result of the verb: a failure unless every arm of every run confirmed.
fn result(replies: Replies<'_>) -> Result {
    let stopped = || replies.iter().filter_map(|(_, reply)| reply.as_ref().ok());
    let confirmed = stopped().flat_map(|reply| reply.arms.values()).all(|c| *c == Confirmation::Confirmed);
    let stopped_any = stopped().next().is_some();
    // A run without the arm is not a failure as long as another one has it.
    let is_elsewhere = |e: &ClientError| matches!(e, ClientError::Refused(e) if e.code == Code::UnknownArm);
    let failures = replies.into_iter().filter_map(|(run, reply)| Some((run, reply.err()?)));
    let mut failures = failures.filter(|(_, e)| !(stopped_any && is_elsewhere(e))).map(|(run, e)| not_stopped(run, e));
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

/// Returns the failure of a run that may not be stopped, with what ends it otherwise.
fn not_stopped(run: &LiveRun, error: ClientError) -> Failure {
    let why = match &error {
        _ if serves_none(run, &error) => "it serves no clients".to_owned(),
        // The run itself refuses, or it is on another computer.
        ClientError::Refused(_) => return error.into(),
        _ if run.at.is_some() => return error.into(),
        ClientError::Io { error, .. } => client::io_text(error),
        ClientError::Protocol { what, .. } => format!("invalid reply: {what}"),
        other => other.to_string(),
    };
    let (name, own) = (&run.name, "its own stop");
    let (pid, hint) = match run.pid {
        0 => ("unknown".to_owned(), own.to_owned()),
        pid => (pid.to_string(), format!("{own}, or kill -INT {pid}: its arms decelerate to rest")),
    };
    Failure::new(Exit::Failed, format!("run {name} (pid {pid}) is not stopped: {why}")).hint(hint)
}

/// Returns whether a run says that it serves no clients (`rpc.enabled: false`), or closes each connection to its mark:
/// it starts or ends.
fn serves_none(run: &LiveRun, error: &ClientError) -> bool {
    match error {
        ClientError::Refused(refusal) => refusal.code == Code::Unsupported,
        ClientError::Io { error, .. } => {
            let is_closed = [ErrorKind::UnexpectedEof, ErrorKind::BrokenPipe, ErrorKind::ConnectionReset];
            run.socket.as_os_str().as_encoded_bytes().starts_with(b"@") && is_closed.contains(&error.kind())
        }
        _ => false,
    }
}

/// Calls `stop` for every run and returns every result. The calls are concurrent: a run that does not answer must not
/// delay the stop of the others. A panic counts as a failure.
fn of_each(runs: &[LiveRun], stop: impl Fn(&LiveRun) -> Result<StopReply, ClientError> + Sync) -> Replies<'_> {
    let panicked = |run: &LiveRun| {
        let what = format!("run {:?} may not be stopped: the request failed unexpectedly", run.name);
        let hint = format!("repeat `dimos stop --run {}`; `dimos state` shows whether its arms are moving", run.name);
        ClientError::from(RpcError::new(Code::Internal, what).hint(hint))
    };
    let stop = &stop;
    std::thread::scope(|scope| {
        let calls: Vec<_> = runs.iter().map(|run| (run, scope.spawn(move || stop(run)))).collect();
        calls.into_iter().map(|(run, call)| (run, call.join().unwrap_or_else(|_| Err(panicked(run))))).collect()
    })
}

fn stop(run: &LiveRun, args: &Args) -> Result<StopReply, ClientError> {
    let _slow = output::note_if_slow(run, "its arms may still move; use their own stop");
    Client::urgent(None, || connect_to(run), &Stop { arm: args.arm.clone() }).map(|(_, reply)| reply)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_whose_stop_panics_is_not_stopped() {
        let run = |name: &str| LiveRun { name: name.into(), pid: 1, socket: "none".into(), at: None };
        let runs = [run("left"), run("right")];
        let stopped = |_: &LiveRun| Ok(StopReply { arms: [("arm".into(), Confirmation::Confirmed)].into() });
        assert_eq!(result(of_each(&runs, stopped)), Ok(Exit::Ok));
        let replies = of_each(&runs, |run| if run.name == "right" { panic!("on purpose") } else { stopped(run) });
        assert!(matches!(replies[..], [(_, Ok(_)), (_, Err(_))]), "{replies:?}");
        let failure = result(replies).unwrap_err();
        assert_eq!(failure.exit, Exit::Failed);
        assert!(failure.what.contains("run \"right\" may not be stopped"), "{failure}");
    }
}
