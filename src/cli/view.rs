//! `dimos view`: prints the URL of a run's live view, with its token; or serves the same page on a log, a robot model
//! or a blueprint, until Ctrl-C.

#[cfg(feature = "view")]
mod elsewhere;
#[cfg(feature = "view")]
mod log;
#[cfg(feature = "view")]
mod posed;

use serde_json::json;

use super::arguments::{Target, is_place_given, place};
use super::exit::{Exit, Failure, Result};
use super::model::With;
use super::output;
use crate::blueprint::Catalog;
use crate::view::foxglove_url;
use dimos_rpc::client;
use dimos_rpc::run_dir::RunDir;

/// Arguments of `view`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
The URL contains a token: with that of a run, everything that `dimos` can do to the arms can be done from the page. A \
new run has a new one. Through ssh: ssh -L 7000:127.0.0.1:7000 HOST, then open the URL in the local browser.
WHAT is a log (.mcap; a file name alone is looked for in the folder of logs too), a robot model (.urdf, .xacro, \
builtin:xarm6), or a blueprint. It is shown until Ctrl-C; nothing is connected and nothing moves.
--foxglove prints the address for Foxglove and Lichtblick: what they connect to reads the run and commands nothing.
With --at the page of a run on another computer is served from this one, until Ctrl-C.")]
pub struct Args {
    /// Show this log, robot model or blueprint; default: the URL of the live run
    #[arg(value_name = "WHAT", conflicts_with = "run")]
    pub what: Option<String>,
    /// Show the newest log
    #[arg(long, conflicts_with_all = ["what", "run"])]
    pub last: bool,
    /// Print the URL for Foxglove instead, which only allows to read
    #[arg(long, conflicts_with_all = ["what", "last"])]
    pub foxglove: bool,
    /// How a robot model is read
    #[command(flatten)]
    with: With,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args, catalog: Catalog<'_>) -> Result {
    if is_place_given() && (args.what.is_some() || args.last) {
        let failure = Failure::usage("files are shown from this computer: --at shows a run");
        return Err(failure.hint("omit --at, or omit the file"));
    }
    if let Some(what) = &args.what {
        return open(args, what, catalog);
    }
    not_of_a_model(args, "what is shown")?;
    if let Some(place) = place().filter(|_| !args.last) {
        return open_elsewhere(args, place);
    }
    if args.last {
        return open(args, &super::log::newest()?.to_string_lossy(), catalog);
    }
    let run = client::find(&RunDir::standard(), args.target_run.run.as_deref())?;
    let Some(url) = client::view_url(&run.name, &run.socket) else {
        let hint = "the blueprint of the run, or of a planner attached to it, needs a robot model or a section `view`";
        return Err(Failure::new(Exit::Failed, format!("run {} has no live view", run.name)).hint(hint));
    };
    print(args, "run", &run.name, &url);
    Ok(Exit::Ok)
}

/// Refuses the options of robot models for something else.
fn not_of_a_model(args: &Args, what: &str) -> Result<()> {
    if args.with == With::default() {
        return Ok(());
    }
    let options = "--package, --xacro-arg, --srdf and --joint-limits";
    Err(Failure::usage(format!("{what} is no robot model: {options} are for one")))
}

fn print(args: &Args, kind: &str, name: &str, url: &str) {
    let foxglove = foxglove_url(url).filter(|_| kind == "run");
    let printed = foxglove.as_deref().filter(|_| args.foxglove).unwrap_or(url);
    match (args.target_run.json, &foxglove) {
        (true, Some(foxglove)) => output::json(&json!({kind: name, "url": url, "foxglove": foxglove})),
        (true, None) => output::json(&json!({kind: name, "url": url})),
        (false, _) => output::line(printed),
    }
}

/// Serves the page on something that is not live.
#[cfg(feature = "view")]
fn open(args: &Args, what: &str, catalog: Catalog<'_>) -> Result {
    use std::path::Path;
    use std::sync::Arc;

    use super::follow::Signals;
    use crate::blueprint::planner::ViewConfig;
    use crate::view::{Subject, View};

    let signals = Signals::watch_with_hangup();
    let path = Path::new(what);
    let (kind, subject): (_, Arc<dyn Subject>) = match path.extension().and_then(|ending| ending.to_str()) {
        Some("mcap") => {
            let log = log::Log::open(&super::log::found(path))?;
            if let Some(loss) = log.loss() {
                output::note(format_args!("warning: the log is not whole: {loss}"));
            }
            ("log", Arc::new(log))
        }
        Some("urdf" | "xacro" | "xml") => ("model", Arc::new(posed::Posed::model(path, &args.with)?)),
        _ if what.starts_with("builtin:") => ("model", Arc::new(posed::Posed::model(path, &args.with)?)),
        _ => ("blueprint", Arc::new(posed::Posed::blueprint(what, catalog)?)),
    };
    if kind != "model" {
        not_of_a_model(args, what)?;
    }
    let view = View::open(&ViewConfig::default(), subject)
        .map_err(|why| Failure::new(Exit::Failed, format!("the page cannot be served: {why}")))?;
    print(args, kind, what, view.url());
    serve(&signals)
}

/// Serves the page of a run on another computer from this one.
#[cfg(feature = "view")]
fn open_elsewhere(args: &Args, place: &str) -> Result {
    let signals = super::follow::Signals::watch_with_hangup();
    let served = elsewhere::open(place, args.target_run.run.as_deref())?;
    print(args, "run", &served.run, served.view.url());
    serve(&signals)
}

/// Waits for the signal that ends the page.
#[cfg(feature = "view")]
fn serve(signals: &super::follow::Signals) -> Result {
    output::note(format_args!("open the URL in a browser; Ctrl-C ends the page"));
    loop {
        if let Some(signal) = signals.last() {
            return Ok(Exit::by_signal(signal));
        }
        std::thread::sleep(std::time::Duration::from_millis(100));
    }
}

#[cfg(not(feature = "view"))]
fn open_elsewhere(_: &Args, _: &str) -> Result {
    Err(Failure::new(Exit::Failed, "this build has no live view (cargo feature `view`)"))
}

#[cfg(not(feature = "view"))]
fn open(_: &Args, _: &str, _: Catalog<'_>) -> Result {
    Err(Failure::new(Exit::Failed, "this build has no live view (cargo feature `view`)"))
}
