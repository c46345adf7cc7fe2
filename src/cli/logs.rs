//! `dimos logs [RUN] [-f]`: the text log of a run without a terminal, live or ended. Of a run on another computer, the
//! lines that it keeps for its clients.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;
use std::time::Duration;

use anyhow::Context;

use super::arguments::{connect, place};
use super::escapes::safe;
use super::exit::{Exit, Failure, Result};
use super::run_record::{RunRecord, RunState};
use super::{lasting, output};
use dimos_rpc::api::TextLog;
use dimos_rpc::client::ClientError;
use dimos_rpc::run_dir::RunDir;

/// Longest line that is printed whole [bytes].
const MAX_LINE: usize = 1 << 20;
/// Poll period of --follow.
const POLL_PERIOD: Duration = Duration::from_millis(100);

/// Arguments of `logs`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Run to show; default: the only live run, otherwise the most recent one
    #[arg(value_name = "RUN")]
    pub name: Option<String>,
    /// The same as the argument RUN
    #[arg(long, value_name = "RUN", conflicts_with = "name")]
    pub run: Option<String>,
    /// Follow the log until the run ends
    #[arg(short, long)]
    pub follow: bool,
    /// Print the run's record and the paths of its logs as JSON
    #[arg(long, conflicts_with = "follow")]
    pub json: bool,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let name = args.name.as_deref().or(args.run.as_deref());
    if place().is_some() {
        return elsewhere(args, name);
    }
    let record = find(name)?;
    if args.json {
        output::json(&record);
        return Ok(Exit::Ok);
    }
    let Some(path) = &record.text_log else {
        let what = format!("{} has no text log: its text goes to its terminal", record.run);
        return Err(Failure::new(Exit::Failed, what).hint("runs started with `dimos run --daemon` have one"));
    };
    show(path, || args.follow && record.lives()).with_context(|| path.display().to_string())?;
    match RunRecord::of(&record.run).filter(|now| args.follow && now.pid == record.pid) {
        Some(now) if now.state() == RunState::Crashed => {
            let what =
                format!("{} crashed: its process (pid {}) is gone without a record of its end", now.run, now.pid);
            Err(Failure::new(Exit::Fault, what).hint("`dimos status` shows what is known of it"))
        }
        _ => Ok(Exit::Ok),
    }
}

/// Prints the latest lines of a run on another computer, and further ones with --follow until Ctrl-C.
fn elsewhere(args: &Args, name: Option<&str>) -> Result {
    if args.json {
        let failure = Failure::usage("--json shows files of this computer, not those of another");
        return Err(failure.hint("`dimos status --json` has the paths on the run's computer"));
    }
    let mut client = connect(name)?;
    let (mut log, mut after) = (None, 0);
    loop {
        let report = match client.call(TextLog { after }) {
            Err(error) if args.follow && lasting::is_lost(&error) => {
                client = lasting::again(client.run(), &error)?;
                continue;
            }
            report => report?,
        };
        // Another run now, with other numbers.
        if log.replace(report.log).is_some_and(|log| log != report.log) && after > 0 {
            after = 0;
            continue;
        }
        if report.lost > 0 && after > 0 {
            output::note(format_args!("({} lines are missing: the run keeps the latest 1000)", report.lost));
        }
        if !report.lines.iter().all(|line| text(&format!("{line}\n"))) {
            return Ok(Exit::Ok);
        }
        after = report.last;
        if report.lines.is_empty() {
            if !args.follow {
                return Ok(Exit::Ok);
            }
            std::thread::sleep(POLL_PERIOD);
        }
    }
}

/// Returns the record of the named run, or of the default one.
fn find(name: Option<&str>) -> Result<RunRecord> {
    let mut live = RunDir::standard().runs().map_err(ClientError::from)?;
    let unknown = |name: &str| {
        let what = format!("no record of a run named {name}");
        Failure::usage(what).hint("`dimos status` shows the live runs")
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
        (None, _) => Err(ClientError::SeveralRuns(live).into()),
    }
}

impl RunRecord {
    /// Returns whether it is live, according to its latest record.
    fn lives(&self) -> bool {
        let now = Self::of(&self.run).filter(|now| now.pid == self.pid && now.started == self.started);
        now.is_some_and(|now| now.state() == RunState::Live)
    }
}

/// Prints text as a terminal may get it; returns whether it still can be written.
fn text(text: &str) -> bool {
    output::data(safe(text, output::colour(&io::stdout())).as_bytes())
}

/// Prints a file, and what is appended while it is expected to grow.
fn show(path: &Path, grows: impl Fn() -> bool) -> io::Result<()> {
    let mut file = File::open(path)?;
    let (mut buffer, mut lines) = (vec![0; 64 * 1024], Vec::new());
    loop {
        // Check before reading, so that everything written before the end is read.
        let goes_on = grows();
        loop {
            let read = file.read(&mut buffer)?;
            if read == 0 {
                break;
            }
            lines.extend_from_slice(buffer.get(..read).unwrap_or_default());
            // Whole lines: a character or a colour may be cut.
            let end = lines.iter().rposition(|byte| *byte == b'\n').map_or(0, |at| at + 1);
            let whole: Vec<u8> = lines.drain(..if lines.len() > MAX_LINE { lines.len() } else { end }).collect();
            if !text(&String::from_utf8_lossy(&whole)) {
                return Ok(());
            }
        }
        if !goes_on {
            text(&String::from_utf8_lossy(&lines));
            return Ok(());
        }
        std::thread::sleep(POLL_PERIOD);
    }
}
