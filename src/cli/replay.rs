//! `dimos replay`: plays a log on the terminal in real time, replays it through the control code, or drives arms with
//! it.

mod keys;
mod onto;
mod player;
mod verify;
mod view;

use std::collections::BTreeMap;
use std::io::{self, IsTerminal};
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Args;
use thiserror::Error;

use super::arguments::{Changes, duration, time};
use super::exit::{Exit, Failure, Result};
use super::output;
use crate::blueprint::Catalog;
use crate::blueprint::TaskTable;
use crate::replay::recorded::RecordedError;
use dimos_log::files;
use dimos_log::replay::{LogInfo, LogReader, ReplayError};
use keys::Keys;
use player::{Pace, Part, RealTime, Waiting, delay, play};
use view::{JsonLines, Live, Plain, View};

/// Play a log in the terminal, or repeat its motion with an arm
///
/// Plays in real time: a joint table and a progress bar on a terminal (space pauses, right arrow plays the next tick,
/// up and down play 10 % faster and slower, q ends), one line per second elsewhere, one JSON object per message with
/// --json. The log of a live run plays up to its newest chunk. Exits with 5 if the log is truncated, or if the recorder
/// lost samples.
///
/// With --onto the arms of a blueprint follow the recorded motion, matched by joint names, in a separate run: first a
/// slow approach to its start, then the motion through the blueprint's trajectory tasks, within all limits. A motion
/// that exceeds a limit is rejected before anything moves. It is not collision-checked. Ctrl-C decelerates the arms to
/// rest.
#[derive(Debug, Clone, Args)]
#[command(override_usage = "dimos replay <LOG | --last> [OPTIONS]")]
pub struct ReplayArgs {
    /// Log file (.mcap): of several the first, or their folder; a name alone is also looked for in the folder of logs
    #[arg(value_name = "LOG", required_unless_present = "last", conflicts_with = "last")]
    pub log: Option<PathBuf>,
    /// Play the newest log
    #[arg(long)]
    pub last: bool,
    /// Speed factor: 2 plays or moves twice as fast
    #[arg(short, long, value_name = "FACTOR", default_value = "1", value_parser = rate, alias = "speed")]
    pub rate: f64,
    /// Repeat from the start
    #[arg(short, long = "loop")]
    pub looping: bool,
    /// Wait for the space bar; needs a terminal
    #[arg(short = 'p', long, conflicts_with_all = ["json", "verify", "blueprint"])]
    pub start_paused: bool,
    /// Wait this long before the first message
    #[arg(short, long, value_name = "TIME", default_value = "0", value_parser = time, conflicts_with_all = ["verify", "blueprint"])]
    pub delay: Duration,
    /// Ignore the keyboard, except for Ctrl-C
    #[arg(long, conflicts_with_all = ["start_paused", "verify", "blueprint"])]
    pub disable_keyboard_controls: bool,
    /// Start this long after the first message, e.g. 1.5, 10s or 2m
    #[arg(long, value_name = "TIME", default_value = "0", value_parser = time)]
    pub start_offset: Duration,
    /// Play this much of the log, e.g. 1.5, 10s or 2m
    #[arg(long, value_name = "TIME", value_parser = duration, visible_alias = "playback-duration")]
    pub duration: Option<Duration>,
    /// End at this Unix time [s]
    #[arg(long, value_name = "UNIX_TIME", value_parser = time, conflicts_with_all = ["duration", "verify"])]
    pub playback_until_sec: Option<Duration>,
    /// Play only these topics, separated by commas
    #[arg(long, value_name = "TOPIC", value_delimiter = ',')]
    pub topics: Vec<String>,
    /// Play all but these topics, separated by commas
    #[arg(long, value_name = "TOPIC", value_delimiter = ',', conflicts_with_all = ["topics", "verify", "blueprint"])]
    pub exclude_topics: Vec<String>,
    /// As `dimos log verify`
    #[arg(long, hide = true, conflicts_with_all = ["rate", "looping", "start_offset", "duration", "topics"])]
    pub verify: bool,
    /// Arguments of --onto
    #[command(flatten)]
    pub onto: OntoArgs,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// Arguments of --onto.
#[derive(Debug, Clone, Args)]
pub struct OntoArgs {
    /// Let the arms of this blueprint follow the recorded motion
    #[arg(long = "onto", value_name = "BLUEPRINT", conflicts_with_all = ["verify", "looping", "topics"])]
    pub blueprint: Option<String>,
    /// Allow real arms to move; by default only simulated arms do
    #[arg(long, requires = "blueprint")]
    pub allow_motion: bool,
    /// Changes of the blueprint
    #[command(flatten)]
    pub changes: Changes,
    /// Name of the run; default: the blueprint's name
    #[arg(long, value_name = "RUN", requires = "blueprint")]
    pub name: Option<String>,
    /// Write the log of the run to this file
    #[arg(long, value_name = "FILE", conflicts_with = "no_record", requires = "blueprint")]
    pub record: Option<PathBuf>,
    /// Write no log of the run
    #[arg(long, requires = "blueprint")]
    pub no_record: bool,
}

fn rate(text: &str) -> std::result::Result<f64, String> {
    let rate: f64 = text.parse().map_err(|_| "not a number".to_owned())?;
    if (1e-3..=1e6).contains(&rate) { Ok(rate) } else { Err("must be between 0.001 and 1000000".into()) }
}

/// Why a log cannot be played as requested.
#[derive(Debug, Error)]
enum SelectionError {
    #[error("there is no log yet{}\nhint: `dimos run` writes one unless --no-record is given", folder_text(.0))]
    NoLogs(Option<PathBuf>),
    #[error("the log {path} has no topic {topic}\nhint: it has {topics}")]
    NoTopic { path: PathBuf, topic: String, topics: String },
    #[error("the log {path} has no messages\nhint: its run {}", if *live { "has just started: try again" } else { "ended before the first tick" })]
    Empty { path: PathBuf, live: bool },
    #[error("the log {path} is only {length:.3} s long\nhint: use a shorter --start-offset")]
    TooShort { path: PathBuf, length: f64 },
    #[error("--playback-until-sec is before the first message that is played, at {from:.3} s\nhint: it is a Unix time")]
    Over { from: f64 },
    #[error("--exclude-topics leaves no topic of the log")]
    Nothing,
}

fn folder_text(folder: &Option<PathBuf>) -> String {
    folder.as_ref().map_or_else(String::new, |f| format!(" in {}", f.display()))
}

/// Plays a log as requested.
pub fn run(args: &ReplayArgs, catalog: Catalog<'_>) -> Result {
    match try_run(args, catalog) {
        // A closed pipe (`| head`) is not an error.
        Err(e) if e.downcast_ref::<io::Error>().is_some_and(|e| e.kind() == io::ErrorKind::BrokenPipe) => Ok(Exit::Ok),
        Err(e) if e.is::<SelectionError>() || e.is::<ReplayError>() || e.is::<RecordedError>() => {
            Err(Failure::of(Exit::Usage, e))
        }
        Err(e) if e.is::<io::Error>() => {
            Err(Failure::new(Exit::Failed, format!("cannot write to standard output: {e}"))
                .hint("what was printed is not complete"))
        }
        other => Ok(other?),
    }
}

/// Verifies a log.
pub fn verify_log(path: &Path, tasks: &TaskTable, json: bool) -> Result {
    verify::run(path, tasks, json).map_err(|e| Failure::of(Exit::Usage, e))
}

fn try_run(args: &ReplayArgs, catalog: Catalog<'_>) -> anyhow::Result<Exit> {
    let path = log_path(args)?;
    if args.verify {
        return Ok(verify::run(&path, catalog.tasks, args.json)?);
    }
    let mut log = LogReader::open(&path)?;
    let part = choose(args, log.info(), &path)?;
    if args.onto.blueprint.is_none() && args.onto.changes != Changes::default() {
        return Err(Failure::usage("--address, --set and --sim change the blueprint of --onto").into());
    }
    if let Some(blueprint) = &args.onto.blueprint {
        return Ok(onto::run(args, blueprint, &path, &part, catalog)?);
    }
    // Times count from the beginning of the log, also of a part of it.
    let began = log.info().span.map_or(part.from, |(start, _)| start);
    let out = io::stdout();
    let tty = out.is_terminal();
    let keys = tty && !args.json && !args.disable_keyboard_controls && io::stdin().is_terminal();
    if args.start_paused && !keys {
        return Err(Failure::usage("--start-paused waits for a key, and there is no terminal").into());
    }
    let mut view: Box<dyn View> = if args.json {
        Box::new(JsonLines::new(out.lock()))
    } else {
        output::note(headline(&path, log.info()));
        let joints = joints(log.info());
        if tty {
            Box::new(Live::new(out.lock(), &part, joints))
        } else {
            Box::new(Plain::new(out.lock(), began, joints))
        }
    };
    let mut time: Box<dyn Waiting> = if keys { Box::new(Keys::open()?) } else { Box::new(RealTime) };
    if let Some(interrupted) = delay(args.delay, time.as_mut()) {
        return Ok(if interrupted { Exit::Interrupted } else { Exit::Ok });
    }
    let end = play(&mut log, &part, Pace::new(args.rate, args.start_paused), view.as_mut(), time.as_mut())?;
    drop((view, time));
    if let Some(loss) = &end.loss {
        output::note(format_args!("warning: the log is not whole: {loss}"));
    }
    if end.lost > 0 {
        let lost = end.lost;
        output::note(format_args!("warning: {lost} samples are missing in this log: the recorder fell behind"));
    }
    if end.interrupted {
        return Ok(Exit::Interrupted);
    }
    Ok(if end.loss.is_some() || end.lost > 0 { Exit::DATA_LOST } else { Exit::Ok })
}

fn log_path(args: &ReplayArgs) -> anyhow::Result<PathBuf> {
    if let Some(path) = &args.log {
        return Ok(super::log::found(path));
    }
    let folder = files::log_folder();
    let newest = folder.as_deref().map(files::newest).transpose()?.flatten();
    Ok(newest.ok_or(SelectionError::NoLogs(folder))?)
}

fn choose(args: &ReplayArgs, info: &LogInfo, path: &Path) -> std::result::Result<Part, SelectionError> {
    let path = path.to_owned();
    if let Some(topic) = args.topics.iter().chain(&args.exclude_topics).find(|t| !info.topics.contains_key(*t)) {
        let topics = info.topics.keys().cloned().collect::<Vec<_>>().join(", ");
        return Err(SelectionError::NoTopic { path, topic: topic.clone(), topics });
    }
    let Some((start, end)) = info.span else { return Err(SelectionError::Empty { path, live: info.live }) };
    let nanoseconds = |d: Duration| u64::try_from(d.as_nanos()).unwrap_or(u64::MAX);
    let from = start.saturating_add(nanoseconds(args.start_offset));
    if from > end {
        return Err(SelectionError::TooShort { path, length: (end - start) as f64 * 1e-9 });
    }
    let to = args.duration.map(|d| from.saturating_add(nanoseconds(d)));
    let to = to.or(args.playback_until_sec.map(nanoseconds)).map_or(end, |to| to.min(end));
    if to < from {
        return Err(SelectionError::Over { from: from as f64 * 1e-9 });
    }
    let mut topics = args.topics.clone();
    if !args.exclude_topics.is_empty() {
        topics = info.topics.keys().filter(|topic| !args.exclude_topics.contains(topic)).cloned().collect();
        // No topics mean all of them.
        if topics.is_empty() {
            return Err(SelectionError::Nothing);
        }
    }
    Ok(Part { topics, from, to, looping: args.looping })
}

/// Returns the number of joints of all arms: grippers follow them in `/joint_states`.
fn joints(info: &LogInfo) -> usize {
    let arms =
        info.metadata.get("arms").and_then(|text| serde_json::from_str::<BTreeMap<String, Vec<String>>>(text).ok());
    arms.map_or(usize::MAX, |arms| arms.values().map(Vec::len).sum())
}

/// Returns a line about the log, before it plays.
fn headline(path: &Path, info: &LogInfo) -> String {
    let run = info.metadata.get("run").map_or_else(String::new, |run| format!(", run {run}"));
    let length = info.span.map_or(0.0, |(start, end)| (end - start) as f64 * 1e-9);
    let (path, live) = (path.display(), if info.live { "live: plays up to " } else { "" });
    let cut = if info.complete || info.live { "" } else { ", cut" };
    format!("{path}: {live}{length:.3} s{run}{cut}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_are_positive_numbers() {
        assert_eq!(rate("0.5"), Ok(0.5));
        for wrong in ["0", "-1", "nan", "inf", "fast"] {
            assert!(rate(wrong).is_err(), "{wrong}");
        }
    }
}
