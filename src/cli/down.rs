//! `dimos down`: ends a run exactly like SIGTERM.

use std::time::{Duration, Instant};

use super::exit::{Exit, Failure, Result};
use super::output;
use crate::rpc::api::Shutdown;
use crate::rpc::client::{self, Client, ClientError};
use crate::rpc::place::RunFolder;

/// How long a controlled end may take, and a little.
const PATIENCE: Duration = Duration::from_secs(6);
/// How often to look.
const INTERVAL: Duration = Duration::from_millis(20);

/// Arguments of `down`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The run to end; needed only when several are live
    pub name: Option<String>,
    /// The same
    #[arg(long, value_name = "NAME", conflicts_with = "name")]
    pub run: Option<String>,
}

/// Runs the verb: asks, and waits until the run is gone.
pub fn run(args: &Args) -> Result {
    let folder = RunFolder::standard();
    let found = client::find(&folder, args.name.as_deref().or(args.run.as_deref()))?;
    Client::connect(&found.name, &found.socket)?.call(Shutdown {})?;
    let asked = Instant::now();
    while folder.runs().map_err(ClientError::from)?.contains(&found) {
        if asked.elapsed() > PATIENCE {
            let what = format!("{} was asked to end, but pid {} still lives", found.name, found.pid);
            return Err(Failure::new(Exit::Failed, what).hint("its own terminal or log says what it waits for"));
        }
        std::thread::sleep(INTERVAL);
    }
    output::note(format_args!("{} ended", found.name));
    Ok(Exit::Ok)
}
