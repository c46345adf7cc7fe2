//! `dimos run NAME|PATH`: starts a run and keeps it up until a signal, its duration, `dimos down` or a fault ends it. A
//! planner whose arms belong to a live run attaches to that run ([`attach`]). With `--daemon` a separate process does
//! that ([`daemon`]).

use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::Context;
use serde::Serialize;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

use super::arguments::{Changes, duration};
use super::attach::{self, Attached};
use super::causes::Causes;
use super::daemon::StartingProcess;
use super::exit::{Exit, Failure, Result};
use super::run_record::RunRecord;
use super::share;
use super::share_child::ShareChild;
use super::text_log::Terminal;
use super::{banner, check, daemon, demo};
use crate::blueprint::Catalog;
use crate::runtime::{Ended, Ending, Options, Record, Run, ServiceManager};
use dimos_rpc::report::StatusReport;
use dimos_rpc::run_dir;

/// Arguments of `run`.
#[derive(Debug, Clone, PartialEq, Default, clap::Args)]
pub struct Args {
    /// The blueprint: a name that `list-blueprints` shows, or a file
    #[arg(value_name = "NAME|PATH")]
    pub blueprint: String,
    /// Changes of the blueprint
    #[command(flatten)]
    pub changes: Changes,
    /// Stop the run after this time: 10s, 2m, or a number of seconds
    #[arg(long, value_name = "TIME", value_parser = duration)]
    pub duration: Option<Duration>,
    /// End the run when this process has ended, however it ended: also by SIGKILL
    #[arg(long, value_name = "PID", value_parser = clap::value_parser!(i32).range(1..))]
    pub end_with: Option<i32>,
    /// Write the log to this file
    #[arg(long, value_name = "FILE", conflicts_with = "no_record")]
    pub record: Option<PathBuf>,
    /// Write no log, except of a fault (recording.fault_log)
    #[arg(long)]
    pub no_record: bool,
    /// Serve no live view
    #[arg(long)]
    pub no_view: bool,
    /// Name of the run; default: the blueprint's name
    #[arg(long, value_name = "RUN")]
    pub name: Option<String>,
    /// Start a separate run, even if a live run has the planner's arms
    #[arg(long, conflicts_with = "attach")]
    pub standalone: bool,
    /// Attach the blueprint's planner to this live run; default: the run that has its arms and tasks, if there is one
    #[arg(long, value_name = "RUN")]
    pub attach: Option<String>,
    /// Start the run in the background; return when the arms are up
    #[arg(short, long)]
    pub daemon: bool,
    /// Introduce the demo
    #[arg(skip)]
    pub demo: bool,
    /// Text log of the background process
    #[arg(long, value_name = "FILE", hide = true)]
    pub text_log: Option<PathBuf>,
    /// As `dimos check`
    #[arg(long, hide = true)]
    pub check: bool,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

impl Args {
    fn options(&self) -> Options {
        let record = match &self.record {
            Some(path) => Record::To(path.clone()),
            None if self.no_record => Record::Faults,
            None => Record::AsBlueprint,
        };
        Options {
            name: self.name.clone(),
            record,
            service_manager: ServiceManager::from_env(),
            view: !self.no_view,
            ..Options::default()
        }
    }
}

/// Runs the verb.
pub fn run(args: &Args, catalog: Catalog<'_>) -> Result {
    if args.check {
        return check::report(&args.blueprint, &args.changes.overrides(), catalog, args.json);
    }
    match &args.text_log {
        None if args.daemon => daemon::start(args, catalog),
        None => match bring_up(args, catalog)? {
            (Up::Run(run, share), causes, terminal) => {
                let record = RunRecord::begin(&run.status(), None);
                let keep = Keep { duration: args.duration, json: args.json, demo: args.demo, seen: true, share };
                keep_up(*run, causes, &terminal, keep, Some(record))
            }
            (Up::Planner(planner), causes, terminal) => {
                causes.watch(planner.endings())?;
                planner.keep_up(&terminal, args, None)
            }
        },
        Some(text_log) => in_background(args, catalog, text_log),
    }
}

/// Runs in the background: reports to the starting process that the run is up, or why not.
fn in_background(args: &Args, catalog: Catalog<'_>, text_log: &Path) -> Result {
    let starter = StartingProcess::detach(text_log)?;
    let (up, causes, terminal) = match bring_up(args, catalog) {
        Ok(up) => up,
        Err(failure) => {
            starter.failed(&failure);
            return Err(failure);
        }
    };
    let (endings, notified) = match &up {
        Up::Run(run, _) => (run.endings(), starter.up(&run.status(), run.socket(), run.view_url(), None)),
        Up::Planner(planner) => {
            (planner.endings(), starter.up(&planner.report(), None, planner.view_url(), Some(planner.run())))
        }
    };
    if !notified {
        terminal.note("the starting process exited before the run was ready");
        let _ = endings.send(Ending::Asked);
    }
    let (run, share) = match up {
        Up::Run(run, share) => (*run, share),
        Up::Planner(planner) => {
            causes.watch(endings)?;
            return planner.keep_up(&terminal, args, Some(text_log));
        }
    };
    let record = RunRecord::begin(&run.status(), Some(text_log));
    let keep = Keep { duration: args.duration, json: false, demo: false, seen: notified, share };
    keep_up(run, causes, &terminal, keep, Some(record))
}

/// What `dimos run` keeps up.
enum Up {
    /// A run, and its gateway to other computers.
    Run(Box<Run>, Option<ShareChild>),
    /// An attached planner.
    Planner(Box<Attached>),
}

/// Fails if a run cannot have this name.
pub(super) fn check_name(name: &str) -> Result<()> {
    run_dir::check_name(name).map_err(|e| Failure::usage(e.to_string()).hint(e.hint()))
}

fn bring_up(args: &Args, catalog: Catalog<'_>) -> Result<(Up, Causes, Terminal)> {
    args.name.as_deref().map(check_name).transpose()?;
    let loaded = check::load_to_run(&args.blueprint, &args.changes.overrides(), catalog)?;
    let Some(blueprint) = &loaded.blueprint else { return Err(check::refuse(&loaded)) };
    check::print_warnings(&loaded);
    // Watched before anything is connected: a signal during startup ends the run, controlled, as soon as it is up.
    let causes = Causes::of(args.end_with)?;
    let terminal = terminal()?;
    if let Some(run) = attach::chosen(args, blueprint)? {
        let planner = Attached::start(args, blueprint, run, &terminal).inspect_err(|_| terminal.flush())?;
        return Ok((Up::Planner(Box::new(planner)), causes, terminal));
    }
    // A build without the network would run it, and not be reached.
    if let Some(config) = blueprint.share.as_ref().filter(|_| cfg!(not(feature = "share"))) {
        crate::share::check_gateway(config)
            .map_err(|error| Failure::usage(format!("share: {}", error.message)).maybe_hint(error.hint))?;
    }
    let options = Options { text: Some(terminal.kept()), ..args.options() };
    let run = Run::start(blueprint, options).map_err(|error| {
        terminal.flush();
        if let Some(manager) = ServiceManager::from_env() {
            manager.status(&error.to_string());
        }
        Failure::from(error)
    })?;
    let share = match &blueprint.share {
        Some(config) => {
            share::lines(config).iter().for_each(|line| terminal.note(format_args!("shared {line}")));
            let child = ShareChild::start(run.name(), config, terminal.clone());
            Some(child.context("cannot start the gateway to other computers")?)
        }
        None => None,
    };
    Ok((Up::Run(Box::new(run), share), causes, terminal))
}

/// Keeps a started run up until a signal, its duration, `dimos down` or a fault ends it, and stops it. Reports on the
/// terminal.
pub fn until_its_end(run: Run, duration: Option<Duration>, json: bool) -> Result {
    let causes = Causes::of(None)?;
    keep_up(run, causes, &terminal()?, Keep { duration, json, demo: false, seen: true, share: None }, None)
}

fn terminal() -> Result<Terminal> {
    Ok(Terminal::start().context("cannot start the thread of the terminal")?)
}

/// How a run is kept up.
struct Keep {
    duration: Option<Duration>,
    json: bool,
    /// Whether it is the demo.
    demo: bool,
    /// Whether a client or a terminal was shown that the run is up: otherwise no one expects its arms to move at
    /// its end.
    seen: bool,
    /// Its gateway to other computers.
    share: Option<ShareChild>,
}

fn keep_up(
    run: Run,
    mut causes: Causes,
    terminal: &Terminal,
    Keep { duration, json, demo, mut seen, share }: Keep,
    record: Option<RunRecord>,
) -> Result {
    for signal in causes.pending() {
        seen = false;
        let _ = run.endings().send(Ending::Signal(signal));
    }
    causes.watch(run.endings())?;
    let report = run.status();
    let in_terminal = record.as_ref().is_none_or(|record| record.text_log.is_none());
    let how_to_end = if in_terminal { banner::IN_A_TERMINAL } else { daemon::HOW_TO_END };
    // The token is shown to a person only: what is not a terminal may be kept.
    let url = run.view_url().filter(|_| in_terminal && std::io::stderr().is_terminal());
    let socket = run.socket().unwrap_or_else(|| Path::new("none"));
    if json || !demo {
        banner::print(terminal, &report, socket, url, how_to_end, json);
    }
    if demo {
        demo::introduce(terminal, &report, url, json);
    }
    let ending = run.wait_for_end(duration);
    share.iter().for_each(ShareChild::run_ends);
    // A terminal that is lost has no one before it who expects a motion, and neither has a program that has ended.
    let unwatched = matches!(ending, Ending::Fault(_) | Ending::Log(_) | Ending::Signal(SIGHUP) | Ending::Orphaned);
    let parks = seen && !unwatched && report.arms.iter().any(banner::parks);
    if !json {
        let then = if parks { banner::PARKING } else { "then releasing the arms" };
        terminal.note(format_args!("{}: decelerating to rest, {then}", why(&ending)));
    }
    let ended = if parks { run.park_and_stop() } else { run.stop() };
    drop(share);
    print_summary(terminal, &report, &ending, &ended, json);
    let exit = match &ending {
        Ending::Fault(_) => Exit::Fault,
        Ending::Log(_) => Exit::Log,
        _ if ended.log_cut.is_some() => Exit::Log,
        Ending::Signal(signal) => Exit::by_signal(*signal),
        Ending::Duration | Ending::Asked | Ending::Orphaned => Exit::Ok,
    };
    if let Some(record) = record {
        let why = ended.log_cut.clone().filter(|_| exit == Exit::Log).unwrap_or_else(|| why(&ending));
        record.end(exit, why, ended.troubles);
    }
    terminal.flush();
    Ok(exit)
}

/// Returns why something ended, in a few words.
pub(super) fn why(ending: &Ending) -> String {
    match ending {
        Ending::Signal(signal) => match *signal {
            SIGINT => "SIGINT".to_owned(),
            SIGTERM => "SIGTERM".to_owned(),
            SIGHUP => "SIGHUP".to_owned(),
            other => format!("signal {other}"),
        },
        Ending::Duration => "duration reached".to_owned(),
        Ending::Asked => "shutdown requested".to_owned(),
        Ending::Orphaned => "the process of --end-with has ended".to_owned(),
        Ending::Log(what) => what.clone(),
        Ending::Fault(what) => format!("FAULT: {what}"),
    }
}

fn print_summary(terminal: &Terminal, report: &StatusReport, ending: &Ending, ended: &Ended, json: bool) {
    #[derive(Serialize)]
    struct Line<'a> {
        event: &'static str,
        run: &'a str,
        why: String,
        troubles: &'a [String],
        #[serde(skip_serializing_if = "<[String]>::is_empty")]
        parked: &'a [String],
        log: Option<&'a PathBuf>,
        #[serde(skip_serializing_if = "Option::is_none")]
        log_cut: Option<&'a String>,
        #[serde(skip_serializing_if = "<[PathBuf]>::is_empty")]
        fault_logs: &'a [PathBuf],
    }
    if json {
        let log = ended.log.as_ref();
        let (run, troubles) = (report.run.as_str(), ended.troubles.as_slice());
        return terminal.json(&Line {
            event: "ended",
            run,
            why: why(ending),
            troubles,
            parked: &ended.parked,
            log,
            log_cut: ended.log_cut.as_ref(),
            fault_logs: &ended.fault_logs,
        });
    }
    for trouble in &ended.troubles {
        terminal.note(format_args!("warning: {trouble}"));
    }
    for arm in &ended.arms {
        terminal.note(format_args!("{}: {}", arm.hardware_id, banner::after_exit(arm, ended)));
    }
    match (&ended.log, &ended.log_cut) {
        (Some(_), Some(cut)) => terminal.note(format_args!("run {} ended; the log is incomplete: {cut}", report.run)),
        (Some(log), None) => terminal.note(format_args!("run {} ended; log: {}", report.run, log.display())),
        (None, _) if ended.fault_logs.is_empty() => {
            terminal.note(format_args!("run {} ended; no log was written", report.run));
        }
        (None, _) => {
            let logs: Vec<_> = ended.fault_logs.iter().map(|log| log.display().to_string()).collect();
            terminal.note(format_args!("run {} ended; logs of faults: {}", report.run, logs.join(", ")));
        }
    }
}
