//! What is kept of a run for those who come later: `<run>.json` beside the logs, written when the run is up and again
//! when it has ended. A record without an end whose process is gone is that of a run that crashed.

use std::io;
use std::path::{Path, PathBuf};

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::exit::{Exit, Failure};
use crate::recording::files;
use crate::rpc::report::StatusReport;

/// How much of the end of a text log is looked at for last words [bytes].
const TAIL: u64 = 8192;
/// So many lines are last words.
const LAST_LINES: usize = 6;

/// The latest run of a name.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    /// The run's name.
    pub run: String,
    /// Its process.
    pub pid: u32,
    /// When the process began, as the kernel counts: a number is used again for another process some day.
    process_began: u64,
    /// When it was up (UTC): `2026-11-21T14:16:30.123Z`.
    pub started: String,
    /// The blueprint's name.
    pub blueprint: String,
    /// Its log.
    pub log: Option<PathBuf>,
    /// Its text log; without one its text went to its terminal.
    pub text_log: Option<PathBuf>,
    /// How it ended.
    pub end: Option<End>,
}

/// How a run ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct End {
    /// When (UTC), written like `started`.
    pub at: String,
    /// Its exit code.
    pub exit: u8,
    /// Why.
    pub why: String,
}

/// What became of a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Fate<'a> {
    /// It lives.
    Lives,
    /// It ended and said so.
    Ended(&'a End),
    /// It is gone without a word.
    Crashed,
}

impl RunRecord {
    /// Notes that a run is up, in this process.
    pub fn begin(report: &StatusReport, text_log: Option<&Path>) -> Self {
        let pid = std::process::id();
        let record = Self {
            run: report.run.clone(),
            pid,
            process_began: process_began(pid).unwrap_or(0),
            started: now(),
            blueprint: report.blueprint.clone(),
            log: report.log.as_ref().map(absolute),
            text_log: text_log.map(absolute),
            end: None,
        };
        record.keep();
        record
    }

    /// Notes how it ended.
    pub fn end(mut self, exit: Exit, why: String) {
        self.end = Some(End { at: now(), exit: exit as u8, why });
        self.keep();
    }

    fn keep(&self) {
        let Some(folder) = files::log_folder() else { return };
        let write = || {
            std::fs::create_dir_all(&folder)?;
            // Whoever reads finds the old record or the new one, never half of one.
            let fresh = folder.join(format!(".{}.json.{}", self.run, self.pid));
            std::fs::write(&fresh, serde_json::to_vec_pretty(self)?)?;
            std::fs::rename(&fresh, path_in(&folder, &self.run))?;
            io::Result::Ok(())
        };
        if let Err(error) = write() {
            tracing::info!("what became of the run is not noted: {}: {error}", folder.display());
        }
    }

    /// The record of a name.
    pub fn of(run: &str) -> Option<Self> {
        crate::rpc::place::check_name(run).ok()?;
        read(&path_in(&files::log_folder()?, run))
    }

    /// All records, the oldest run first.
    pub fn all() -> Vec<Self> {
        let entries = files::log_folder().and_then(|folder| std::fs::read_dir(folder).ok());
        let mut all: Vec<Self> =
            entries.into_iter().flatten().filter_map(|entry| entry.ok().and_then(|e| read(&e.path()))).collect();
        all.sort_by(|a, b| a.started.cmp(&b.started));
        all
    }

    /// What became of it.
    pub fn fate(&self) -> Fate<'_> {
        match &self.end {
            Some(end) => Fate::Ended(end),
            None if process_began(self.pid) == Some(self.process_began) => Fate::Lives,
            None => Fate::Crashed,
        }
    }

    /// Whether it came to an end that nobody wanted: it crashed, or a fault or the end of its log ended it.
    pub fn fell(&self) -> bool {
        match self.fate() {
            Fate::Lives => false,
            Fate::Ended(end) => [Exit::Fault as u8, Exit::Log as u8].contains(&end.exit),
            Fate::Crashed => true,
        }
    }

    /// What became of it, in a sentence without full stop; `None` while it lives.
    pub fn obituary(&self) -> Option<String> {
        let (run, pid) = (&self.run, self.pid);
        match self.fate() {
            Fate::Lives => None,
            Fate::Ended(end) => Some(format!("{run} (pid {pid}) ended {}: {}", end.at, end.why)),
            Fate::Crashed => Some(format!("{run} (pid {pid}), up since {}, crashed", self.started)),
        }
    }

    /// The last lines of its text log.
    pub fn last_words(&self) -> Vec<String> {
        self.text_log.as_deref().map(last_lines).unwrap_or_default()
    }

    /// Why a verb cannot talk to it; `None` while it lives.
    pub fn failure(&self) -> Option<Failure> {
        let mut what = format!("no live run is named {}: {}", self.run, self.obituary()?);
        for line in self.last_words().iter().filter(|_| self.fell()) {
            what += &format!("\n  {line}");
        }
        let hint = match &self.text_log {
            Some(_) => format!("its text log: dimos logs {}", self.run),
            None => format!("start it again: dimos run {} --name {}", self.blueprint, self.run),
        };
        Some(Failure::new(Exit::Failed, what).hint(hint))
    }
}

/// A path for readers who are in another folder.
fn absolute(path: impl AsRef<Path>) -> PathBuf {
    std::path::absolute(path.as_ref()).unwrap_or_else(|_| path.as_ref().to_owned())
}

/// The time, written so that later times sort behind earlier ones.
fn now() -> String {
    format!("{:.3}", Timestamp::now())
}

fn path_in(folder: &Path, run: &str) -> PathBuf {
    folder.join(format!("{run}.json"))
}

/// The record in a file; `None` where there is none, or it is something else.
fn read(path: &Path) -> Option<RunRecord> {
    path.extension().filter(|ending| *ending == "json")?;
    serde_json::from_slice(&std::fs::read(path).ok()?).ok()
}

/// The last lines of a text file; none where it cannot be read.
pub fn last_lines(path: &Path) -> Vec<String> {
    use std::io::{Read, Seek, SeekFrom};
    let tail = || {
        let mut file = std::fs::File::open(path)?;
        let length = file.metadata()?.len();
        file.seek(SeekFrom::Start(length.saturating_sub(TAIL)))?;
        let mut bytes = Vec::new();
        file.take(TAIL).read_to_end(&mut bytes)?;
        io::Result::Ok(String::from_utf8_lossy(&bytes).into_owned())
    };
    let text = tail().unwrap_or_default();
    let lines: Vec<&str> = text.lines().filter(|line| !line.trim().is_empty()).collect();
    lines.iter().skip(lines.len().saturating_sub(LAST_LINES)).map(|&line| line.to_owned()).collect()
}

/// When a process began, in ticks since the machine did; `None` when there is no such process, or only its remains.
fn process_began(pid: u32) -> Option<u64> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The name of the program stands in parentheses and may contain anything.
    let mut fields = stat.rsplit_once(')')?.1.split_whitespace();
    if matches!(fields.next()?, "Z" | "X") {
        return None;
    }
    fields.nth(18)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(pid: u32, process_began: u64) -> RunRecord {
        RunRecord {
            run: "r".into(),
            pid,
            process_began,
            started: "1970-01-01T00:00:00.000Z".into(),
            blueprint: "b".into(),
            log: None,
            text_log: None,
            end: None,
        }
    }

    #[test]
    fn a_process_is_known_by_its_number_and_when_it_began() {
        let us = std::process::id();
        let began = process_began(us).unwrap();
        assert_eq!(record(us, began).fate(), Fate::Lives);
        assert_eq!(record(us, began + 1).fate(), Fate::Crashed, "another process has the number now");
        let mut child = std::process::Command::new("true").spawn().unwrap();
        let pid = child.id();
        child.wait().unwrap();
        assert_eq!(process_began(pid), None);
    }

    #[test]
    fn only_an_end_that_nobody_wanted_is_a_fall() {
        let ended = |exit: Exit| {
            let end = End { at: "1970-01-01T00:00:00.000Z".into(), exit: exit as u8, why: "w".into() };
            RunRecord { end: Some(end), ..record(1, 0) }
        };
        assert!(ended(Exit::Fault).fell() && !ended(Exit::Terminated).fell() && !ended(Exit::Ok).fell());
        assert_eq!(ended(Exit::Ok).obituary().unwrap(), "r (pid 1) ended 1970-01-01T00:00:00.000Z: w");
        assert!(record(std::process::id(), 0).failure().unwrap().what.contains("crashed"));
    }

    #[test]
    fn last_words_are_the_last_lines_that_say_something() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let text: String = (0..2000).map(|n| format!("line {n}\n\n")).collect();
        std::fs::write(file.path(), text).unwrap();
        let expected: Vec<String> = (1994..2000).map(|n| format!("line {n}")).collect();
        assert_eq!(last_lines(file.path()), expected);
        assert!(last_lines(Path::new("/nonexistent")).is_empty());
    }
}
