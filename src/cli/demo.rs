//! `dimos demo`: a simulated cell to look at, with two arms, a wall, a part, and a job that carries it.

use std::io::IsTerminal;
use std::time::Duration;

use serde_json::json;

use super::arguments::{Changes, Simulation, duration};
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
/// The arms of the cell.
const ARMS: [&str; 2] = ["left", "right"];
/// The job in the program, as `do` names it.
pub const JOB: &str = "builtin:demo";
/// Its text.
pub const JOB_TEXT: &str = include_str!("../../assets/demo-job.yaml");

/// Three things to try, and what each shows.
const TRIES: [(&str, &str); 3] = [
    ("dimos do builtin:demo", "the arms carry the part over the wall, and back: 40 s"),
    ("dimos top", "live status of arms and motions; q ends it"),
    ("dimos move right --pose 0.35 0.2 0.3", "reaches over the wall, to x y z [m]"),
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
        changes: Changes { sim: Some(Simulation::Wire), ..Changes::default() },
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
    let is_cell = report.blueprint == NAME && report.arms.iter().map(|arm| arm.hardware_id.as_str()).eq(ARMS);
    (is_cell && report.standing() == "SIMULATED").then_some((found, report))
}

/// Shows a demo that is live already.
fn show(found: &LiveRun, report: &StatusReport, as_json: bool) {
    let url = client::view_url(&found.name, &found.socket).filter(|_| as_json || std::io::stderr().is_terminal());
    if as_json {
        return output::json(&to_json(report, url.as_deref()));
    }
    output::note(format_args!("the demo is running already (pid {}); to end it: dimos down {NAME}", found.pid));
    lines(report, url.as_deref()).iter().for_each(output::note);
}

/// Prints what the demo is and what to try: for people in place of the banner, as JSON behind that.
pub(super) fn introduce(terminal: &Terminal, report: &StatusReport, url: Option<&str>, as_json: bool) {
    if as_json {
        return terminal.json(&to_json(report, url));
    }
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

/// Returns the three commands, each with what it shows.
fn tries() -> [(String, &'static str); 3] {
    // Beside other runs, commands name theirs.
    let several = RunDir::standard().runs().is_ok_and(|live| live.len() > 1);
    let selector = if several { format!(" --run {NAME}") } else { String::new() };
    TRIES.map(|(command, what)| (command.to_owned() + &selector, what))
}

/// Returns the address of the page, and the three commands.
fn lines(report: &StatusReport, url: Option<&str>) -> Vec<String> {
    let page =
        report.view.as_deref().map(|address| url.map_or_else(|| banner::view_without_token(address), str::to_owned));
    let page = page.map(|page| format!("The page, for a browser:  {page}"));
    let tries = tries();
    let width = tries.iter().map(|(command, _)| command.len()).max().unwrap_or(0);
    let tries = tries.iter().map(|(command, what)| format!("  {command:width$}  {what}"));
    page.into_iter().chain(["Three things to try, in a second terminal:".to_owned()]).chain(tries).collect()
}

fn to_json(report: &StatusReport, url: Option<&str>) -> serde_json::Value {
    let tries = tries().map(|(command, _)| command);
    json!({"event": "demo", "run": report.run, "pid": report.pid, "view": url.or(report.view.as_deref()), "try": tries})
}
