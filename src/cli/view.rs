//! `dimos view`: prints the URL of a run's live view, with its token.

use std::path::PathBuf;

use serde::Serialize;

use super::arguments::Target;
use super::exit::{Exit, Failure, Result};
use super::output;
use crate::rpc::api::Status;
use crate::rpc::client::{self, Client};
use crate::rpc::run_dir::{LiveRun, RunDir, view_file};

/// Arguments of `view`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
The URL contains the run's token: with it, everything that `dimos` can do to the arms can be done from the page. A new \
run has a new one. Through ssh: ssh -L 7000:127.0.0.1:7000 HOST, then open the URL in the local browser.")]
pub struct Args {
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

#[derive(Serialize)]
struct View<'a> {
    run: &'a str,
    url: &'a str,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let run = client::find(&RunDir::standard(), args.target_run.run.as_deref())?;
    let read = |file: PathBuf| std::fs::read_to_string(file).ok();
    let Some(text) = of_planner(&run).and_then(read).or_else(|| read(view_file(&run.socket))) else {
        let hint = "the blueprint of the run, or of a planner attached to it, needs a robot model or a section `view`";
        return Err(Failure::new(Exit::Failed, format!("run {} has no live view", run.name)).hint(hint));
    };
    let url = text.trim();
    match args.target_run.json {
        true => output::json(&View { run: &run.name, url }),
        false => output::line(url),
    }
    Ok(Exit::Ok)
}

/// Returns the file of the planner that is attached to a run, whose page also has the planner's robots.
fn of_planner(run: &LiveRun) -> Option<PathBuf> {
    let status = Client::connect(&run.name, &run.socket).ok()?.call(Status {}).ok()?;
    let name = status.planner?.attached?.name;
    Some(RunDir::standard().planners().path().join(format!("{name}.view")))
}
