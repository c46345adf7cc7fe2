//! `dimos logs [RUN] [-f]`: the text log of a run without a terminal, live or dead.

use std::fs::File;
use std::io::{self, Read, Write};
use std::path::Path;
use std::time::Duration;

use anyhow::Context;

use super::exit::{Exit, Failure, Result};
use super::output;
use super::run_record::{Fate, RunRecord};
use crate::rpc::client::{self, ClientError};
use crate::rpc::place::RunFolder;

/// How often a log that is followed is looked at.
const INTERVAL: Duration = Duration::from_millis(100);

/// Arguments of `logs`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The run; without it the only live one or, where none lives, the last that did
    pub name: Option<String>,
    /// The same
    #[arg(long, value_name = "NAME", conflicts_with = "name")]
    pub run: Option<String>,
    /// Go on until the run has ended
    #[arg(short, long)]
    pub follow: bool,
    /// Print what is known of the run, and where its logs are, as JSON
    #[arg(long, conflicts_with = "follow")]
    pub json: bool,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let record = find(args.name.as_deref().or(args.run.as_deref()))?;
    if args.json {
        output::json(&record);
        return Ok(Exit::Ok);
    }
    let Some(path) = &record.text_log else {
        let what = format!("{} has no text log: its text goes to its terminal", record.run);
        return Err(Failure::new(Exit::Failed, what).hint("runs started with `dimos run --daemon` have one"));
    };
    show(path, || args.follow && record.lives()).with_context(|| path.display().to_string())?;
    Ok(Exit::Ok)
}

/// The record of a run, or of the one that is meant where none is named.
fn find(name: Option<&str>) -> Result<RunRecord> {
    let mut live = RunFolder::standard().runs().map_err(ClientError::from)?;
    let unknown = |name: &str| {
        let what = format!("nothing is known of a run named {name}");
        Failure::usage(what).hint("`dimos status` shows the runs that live")
    };
    match (name, live.len()) {
        (Some(name), _) => RunRecord::of(name).ok_or_else(|| unknown(name)),
        (None, 0) => {
            let newest = RunRecord::all().into_iter().rfind(|record| record.text_log.is_some());
            newest.ok_or_else(|| ClientError::NoRun.into())
        }
        (None, 1) => {
            let name = live.pop().map(|run| run.name).unwrap_or_default();
            RunRecord::of(&name).ok_or_else(|| unknown(&name))
        }
        (None, _) => Err(client::ClientError::SeveralRuns(live).into()),
    }
}

impl RunRecord {
    /// Whether it lives, as far as has been noted by now.
    fn lives(&self) -> bool {
        let now = Self::of(&self.run).filter(|now| now.pid == self.pid && now.started == self.started);
        now.is_some_and(|now| now.fate() == Fate::Lives)
    }
}

/// Prints a file, and what is added to it as long as it is expected to grow.
fn show(path: &Path, grows: impl Fn() -> bool) -> io::Result<()> {
    let mut file = File::open(path)?;
    let mut buffer = vec![0; 64 * 1024];
    loop {
        // Asked before reading: what was written before the end is then read.
        let goes_on = grows();
        loop {
            let read = file.read(&mut buffer)?;
            if read == 0 {
                break;
            }
            let printed = io::stdout().lock().write_all(buffer.get(..read).unwrap_or_default());
            if printed.and_then(|()| io::stdout().flush()).is_err() {
                return Ok(()); // Nobody reads it any more.
            }
        }
        if !goes_on {
            return Ok(());
        }
        std::thread::sleep(INTERVAL);
    }
}
