//! `dimos view`: prints the URL of a run's live view, with its token.

use serde::Serialize;

use super::arguments::Target;
use super::exit::{Exit, Failure, Result};
use super::output;
use crate::rpc::client;
use crate::rpc::run_dir::{RunDir, view_file};

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
    let Ok(text) = std::fs::read_to_string(view_file(&run.socket)) else {
        let hint = "its blueprint needs a robot model or a section `view`, and the run no --no-view";
        return Err(Failure::new(Exit::Failed, format!("run {} has no live view", run.name)).hint(hint));
    };
    let url = text.trim();
    match args.target_run.json {
        true => output::json(&View { run: &run.name, url }),
        false => output::line(url),
    }
    Ok(Exit::Ok)
}
