//! `dimos demo`: a simulated cell to look at, with two arms, a wall, a part, and a job that carries it.

use std::io::IsTerminal;
use std::time::Duration;

use serde_json::json;

use super::arguments::{Changes, duration};
use super::exit::{Exit, Result};
use super::run;
use super::text_log::Terminal;
use super::{banner, output};
use crate::blueprint::Catalog;
use dimos_rpc::api::Status;
use dimos_rpc::client::{self, Client};
use dimos_rpc::report::StatusReport;
use dimos_rpc::run_dir::{LiveRun, RunDir};

/// Name of the run, and of its blueprint.
const NAME: &str = "demo";
/// The blueprint in the program: a file of that name may have real arms.
const BLUEPRINT: &str = "builtin:demo";
/// The job in the program, as `do` names it.
pub const JOB: &str = "builtin:demo";
/// Its text.
pub const JOB_TEXT: &str = include_str!("../../assets/demo-job.yaml");

/// Three things to try, and what each shows.
const TRIES: [(&str, &str); 3] = [
    ("dimos do builtin:demo", "the arms carry the part over the wall, and back; each motion is planned"),
    ("dimos top", "live status of arms, motions and timing; q ends it"),
    ("dimos move right --pose 0.35 0.2 0.3", "the right arm reaches over the wall; try other positions [m]"),
];

/// Arguments of `demo`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Both arms are emulated, whatever files and addresses there are. Nothing moves until you type the first of the three \
commands that it prints: here as everywhere, a start moves no arm. Ctrl-C ends the demo.

Its parts are there to be copied: `dimos check builtin:demo` shows the cell, `dimos demo --job` prints the job.")]
pub struct Args {
    /// Print the job, to make your own from; start nothing
    #[arg(long)]
    pub job: bool,
    /// End the demo after this time: 10s, 2m, or a number of seconds
    #[arg(long, value_name = "TIME", value_parser = duration)]
    pub duration: Option<Duration>,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// Runs the verb: starts the demo, or shows the one that is live.
pub fn run(args: &Args, catalog: Catalog<'_>) -> Result {
    if args.job {
        match args.json {
            true => output::json(&json!({"job": JOB_TEXT})),
            false => output::line(JOB_TEXT.trim_end()),
        }
        return Ok(Exit::Ok);
    }
    if let Some((found, report)) = live() {
        show(&found, &report, args.json);
        return Ok(Exit::Ok);
    }
    let args = run::Args {
        blueprint: BLUEPRINT.to_owned(),
        duration: args.duration,
        json: args.json,
        // A program that embeds this one may have another blueprint of that name.
        changes: Changes { sim: true, ..Changes::default() },
        // A run that has arms of these names is another one.
        standalone: true,
        demo: true,
        ..run::Args::default()
    };
    run::run(&args, catalog)
}

/// Returns the demo that is live. Another run of its name is none.
fn live() -> Option<(LiveRun, StatusReport)> {
    let found = client::find(&RunDir::standard(), Some(NAME)).ok()?;
    let report = Client::connect(&found.name, &found.socket).ok()?.call(Status {}).ok()?;
    (report.blueprint == NAME && report.standing() == "SIMULATED").then_some((found, report))
}

/// Shows a demo that is live already.
fn show(found: &LiveRun, report: &StatusReport, as_json: bool) {
    let tries = TRIES.map(|(command, _)| command.to_owned() + selector());
    let url = client::view_url(&found.name, &found.socket).filter(|_| as_json || std::io::stderr().is_terminal());
    if as_json {
        return output::json(&json!({"run": found.name, "pid": found.pid, "view": url, "try": tries}));
    }
    output::note(format_args!("the demo is running already (pid {}); to end it: dimos down {NAME}", found.pid));
    lines(report, url.as_deref()).iter().for_each(output::note);
}

/// Prints what the demo is and what to try, in place of the banner.
pub fn introduce(terminal: &Terminal, report: &StatusReport, url: Option<&str>) {
    terminal.note(format_args!("{}  (pid {}, dimos {})", banner::heading(report), report.pid, report.version));
    terminal.note("Two arms, a wall between them, a part to carry. Nothing moves until you ask.");
    for line in lines(report, url) {
        match url {
            Some(url) if line.contains(url) => terminal.private(line),
            _ => terminal.note(line),
        }
    }
    terminal.note("Press Ctrl-C for a controlled stop.");
}

/// Returns the address of the page, and the three commands.
fn lines(report: &StatusReport, url: Option<&str>) -> Vec<String> {
    let page =
        report.view.as_deref().map(|address| url.map_or_else(|| banner::view_without_token(address), str::to_owned));
    let page = page.map(|page| format!("The page, for a browser:  {page}"));
    let tries = TRIES.map(|(command, what)| format!("  {:<38}  {what}", command.to_owned() + selector()));
    page.into_iter().chain(["Three things to try, in a second terminal:".to_owned()]).chain(tries).collect()
}

/// Returns how the commands name the demo, beside other runs.
fn selector() -> &'static str {
    match RunDir::standard().runs() {
        Ok(live) if live.len() > 1 => " --run demo",
        _ => "",
    }
}
