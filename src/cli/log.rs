//! `dimos log`: list, check, print, cut, repair, export and plot logs.

mod cat;
mod copy;
mod doctor;
mod export;
mod info;
mod lerobot;
mod list;
mod plot;
pub mod progress;
mod python_writer;
mod rosbag;
mod what_if;

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::arguments::{setting, time};
use super::exit::{Exit, Failure, Result};
use super::replay;
use crate::blueprint::Catalog;
use dimos_log::files;
use dimos_log::messages::JointState;
use dimos_log::replay::{LogInfo, ReplayError};
use dimos_log::source::Source;
use dimos_log::wire::Message;

/// Topic of joint states.
pub(super) const STATES: &str = "/joint_states";

/// Arguments of `log`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
LOG is a file, also of another program; a file name alone is looked for in the folder of logs too.
Times count from the beginning of the log: 1.5, 10s, 2m.
Exit code 5: the log is cut, damaged, or has lost data. Everything that can be read was used.")]
pub struct Args {
    /// What to do
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    /// List the logs of runs, the newest first
    List {
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Show what is in a log: topics, counts, rates, faults
    Info(Log),
    /// Print the messages of a log, one a line
    Cat {
        #[command(flatten)]
        log: Log,
        #[command(flatten)]
        part: Part,
        /// Print only these topics, separated by commas
        #[arg(long, value_name = "TOPIC", value_delimiter = ',')]
        topics: Vec<String>,
    },
    /// Read all of a log and check it: checksums, order, gaps, messages
    Doctor(Log),
    /// Replay a log through the control code and compare its commands bit for bit
    ///
    /// The inputs and requests of every tick pass through the same control code again, and every command must be
    /// identical. Otherwise exits with 1 and prints the first difference; exits with 5 if a part is missing in the log,
    /// up to which all commands are identical.
    Verify(Log),
    /// Run a log again with a changed limit, task or tolerance, and show what differs
    #[command(after_help = "\
A PATH leads into coordinator.json, an attachment of the log. Names select arms, tasks and joints; groups in between may \
be left out:
  arms.arm.velocity_max=0.5              all joints [rad/s]
  arms.arm.velocity_max.arm_joint2=0.5   one joint
  tasks.traj_arm.path_tolerance=0.05     [rad]
A wrong PATH shows what there is. The states are those of the log: how the arms would have followed other commands is \
unknown.")]
    WhatIf {
        #[command(flatten)]
        log: Log,
        /// Change a value (repeatable)
        #[arg(long, value_name = "PATH=VALUE", value_parser = setting, required = true)]
        set: Vec<(String, String)>,
        /// Write every command that differs to this new file (CSV)
        #[arg(short, long, value_name = "FILE")]
        output: Option<PathBuf>,
    },
    /// Write a part of a log to a new file, which begins with the state at that time
    Cut {
        #[command(flatten)]
        log: Log,
        #[command(flatten)]
        part: Part,
        /// The new file
        #[arg(short, long, value_name = "FILE")]
        output: PathBuf,
    },
    /// Write what can be read of a damaged log to a new file
    Recover {
        #[command(flatten)]
        log: Log,
        /// The new file; default: LOG-recovered.mcap
        #[arg(short, long, value_name = "FILE")]
        output: Option<PathBuf>,
    },
    /// Export joint states and commands, or one topic, as CSV; or as Parquet, rosbag2 or LeRobot data set
    #[command(after_help = "\
A row has the time [s], and of each joint its position, velocity, effort and commanded value. Values that are unknown \
are empty. With --topic a row is a message, with the columns of all of them.")]
    Export {
        #[command(flatten)]
        log: Log,
        #[command(flatten)]
        part: Part,
        /// Export this topic instead, e.g. /wrench/arm
        #[arg(long, value_name = "TOPIC")]
        topic: Option<String>,
        /// The new CSV file; default: standard output
        #[arg(short, long, value_name = "FILE")]
        output: Option<PathBuf>,
        /// Write a Parquet file with the same columns; unknown values are NaN. Needs Python with pyarrow
        #[arg(long, value_name = "FILE", conflicts_with_all = ["topic", "output"])]
        parquet: Option<PathBuf>,
        /// Write a folder that `ros2 bag` opens, with all topics
        #[arg(long, value_name = "DIR", conflicts_with_all = ["topic", "output", "parquet"])]
        rosbag2: Option<PathBuf>,
        /// Write a LeRobot data set (v3.0) with one episode: positions are states, commanded positions are actions.
        /// Needs Python with lerobot
        #[arg(long, value_name = "DIR", conflicts_with_all = ["topic", "output", "parquet", "rosbag2"])]
        lerobot: Option<PathBuf>,
        /// Frames per second of the data set; default: the tick rate
        #[arg(long, value_name = "N", requires = "lerobot", value_parser = clap::value_parser!(u32).range(1..=2000))]
        fps: Option<u32>,
        /// What the arms do in the data set; default: the name of the run
        #[arg(long, value_name = "TEXT", requires = "lerobot")]
        task: Option<String>,
    },
    /// Draw measured and commanded positions of joints, with their limits, as SVG
    Plot {
        #[command(flatten)]
        log: Log,
        #[command(flatten)]
        part: Part,
        /// Draw only these joints, separated by commas
        #[arg(long, value_name = "NAME", value_delimiter = ',')]
        joint: Vec<String>,
        /// The new file (.svg); a file of that name is replaced
        #[arg(short, long, value_name = "FILE")]
        output: PathBuf,
    },
}

/// Which log.
#[derive(Debug, clap::Args)]
struct Log {
    /// Log file (.mcap): of several the first, or their folder
    #[arg(value_name = "LOG", required_unless_present = "last", conflicts_with = "last")]
    log: Option<PathBuf>,
    /// Use the newest log
    #[arg(long)]
    last: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Which part of it.
#[derive(Debug, clap::Args)]
struct Part {
    /// Begin this long after the first message
    #[arg(long, value_name = "TIME", default_value = "0", value_parser = time)]
    from: Duration,
    /// End this long after the first message
    #[arg(long, value_name = "TIME", value_parser = time)]
    to: Option<Duration>,
}

/// Runs the verb.
pub fn run(args: &Args, catalog: Catalog<'_>) -> Result {
    match &args.command {
        Command::List { json } => list::run(*json),
        Command::Info(log) => info::run(&log.path()?, log.json),
        Command::Cat { log, part, topics } => cat::run(&log.path()?, part, topics, log.json),
        Command::Doctor(log) => doctor::run(&log.path()?, log.json),
        Command::Verify(log) => replay::verify_log(&log.path()?, catalog.tasks, log.json),
        Command::WhatIf { log, set, output } => {
            let run = || what_if::run(&log.path()?, catalog.tasks, set, output.as_deref(), log.json);
            output.as_deref().map_or_else(run, |to| whole_or_nothing(to, run))
        }
        Command::Cut { log, part, output } => copy::cut(&log.path()?, part, output, log.json),
        Command::Recover { log, output } => copy::recover(&log.path()?, output.as_deref(), log.json),
        Command::Export { log, part, topic, output, parquet, rosbag2, lerobot, fps, task } => {
            let path = log.path()?;
            let run = || match (parquet, rosbag2, lerobot) {
                (Some(to), ..) => export::parquet(&path, part, to, log.json),
                (_, Some(to), _) => rosbag::run(&path, part, to, log.json),
                (.., Some(to)) => lerobot::run(&path, part, to, *fps, task.as_deref(), log.json),
                _ => export::csv(&path, part, topic.as_deref(), output.as_deref(), log.json),
            };
            let to = parquet.as_deref().or(rosbag2.as_deref()).or(lerobot.as_deref()).or(output.as_deref());
            to.map_or_else(run, |to| whole_or_nothing(to, run))
        }
        Command::Plot { log, part, joint, output } => plot::run(&log.path()?, part, joint, output, log.json),
    }
}

impl Log {
    /// Returns the path of the log.
    fn path(&self) -> Result<PathBuf> {
        if let Some(path) = &self.log {
            return Ok(found(path));
        }
        newest()
    }
}

/// Returns the path of the newest log.
pub(super) fn newest() -> Result<PathBuf> {
    let folder = files::log_folder();
    let newest = folder.as_deref().map(files::newest).transpose().map_err(|e| Failure::of(Exit::Failed, e))?;
    let none = || Failure::usage("there is no log yet").hint("`dimos run` writes one unless --no-record is given");
    newest.flatten().ok_or_else(none)
}

/// Returns the names of the logs in the folder of logs.
pub(super) fn kept() -> Vec<String> {
    let logs = files::log_folder().and_then(|folder| files::all(&folder).ok()).unwrap_or_default();
    logs.iter().filter_map(|path| path.file_name()?.to_str().map(str::to_owned)).collect()
}

/// Returns the path of a log, which may be the name alone of one in the folder of logs.
pub(super) fn found(path: &Path) -> PathBuf {
    let listed = files::log_folder().map(|folder| folder.join(path));
    let listed = listed.filter(|listed| !path.exists() && listed.exists());
    listed.unwrap_or_else(|| path.to_owned())
}

impl Part {
    /// Returns the first and last Unix time [ns], within a log that has messages.
    fn of(&self, path: &Path) -> Result<(u64, u64)> {
        let source = Source::open(path).map_err(unreadable)?;
        let empty = || Failure::usage(format!("the log {} has no messages", path.display()));
        let (start, end) = source.span().ok_or_else(empty)?;
        let at = |offset: Duration| start.saturating_add(offset.as_nanos().try_into().unwrap_or(u64::MAX));
        let (from, to) = (at(self.from), self.to.map_or(end, at));
        if from > end || from > to {
            let length = (end - start) as f64 * 1e-9;
            let what = format!("nothing is between --from and --to: the log is {length:.3} s long");
            return Err(Failure::usage(what).hint("both count from the beginning of the log"));
        }
        Ok((from, to))
    }
}

/// Returns the failure of a file that is no log.
fn unreadable(error: ReplayError) -> Failure {
    Failure::of(Exit::Usage, error)
}

/// Writes a new file or folder. If that fails, removes what there is of it: the next attempt finds its name free.
fn whole_or_nothing(to: &Path, write: impl FnOnce() -> Result) -> Result {
    // Also what a broken link leads to is not ours.
    let before = to.symlink_metadata().is_ok();
    let result = write();
    if result.is_err() && !before {
        let _ = if to.is_dir() { std::fs::remove_dir_all(to) } else { std::fs::remove_file(to) };
    }
    result
}

/// Prints what the part of a log that was read lacks; returns the exit code.
fn ended(loss: Option<&str>) -> Exit {
    match loss {
        None => Exit::Ok,
        Some(loss) => {
            super::output::note(format_args!("warning: the log is not whole: {loss}"));
            Exit::Log
        }
    }
}

/// Returns the failure of a log without joint states where they are looked for; names where they are.
pub(super) fn no_states(path: &Path, info: &LogInfo) -> Failure {
    let states = info.topics.iter().filter(|(topic, schema)| *schema == JointState::SCHEMA && *topic != STATES);
    let elsewhere: Vec<&str> = states.map(|(topic, _)| topic.as_str()).collect();
    let at = match elsewhere.is_empty() {
        true => String::new(),
        false => format!("; joint states are on {}", elsewhere.join(", ")),
    };
    let failure = Failure::usage(format!("{}: the log has no {STATES} in this part{at}", path.display()));
    failure.hint("`dimos log info` shows its topics")
}

/// Writes text; `false` if the reader has closed the pipe.
fn written(out: &mut dyn Write, text: &str) -> Result<bool> {
    match out.write_all(text.as_bytes()) {
        Ok(()) => Ok(true),
        Err(e) if e.kind() == io::ErrorKind::BrokenPipe => Ok(false),
        Err(e) => Err(Failure::new(Exit::Failed, format!("cannot write: {e}"))),
    }
}
