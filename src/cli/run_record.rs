//! Record of the latest run of a name: `<run>.json` beside the logs, written when the run is up and again when it has
//! ended. A record without an end whose process is gone belongs to a crashed run.

use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::exit::{Exit, Failure};
use dimos_core::bounded;
use dimos_log::files;
use dimos_rpc::report::StatusReport;

/// Size of the tail of a text log that is searched for its last lines [bytes].
const TAIL: u64 = 8192;
/// Maximum time from the release of a run's name to the record of its end.
const LAST_LINES_LIMIT: Duration = Duration::from_secs(2);
/// Maximum number of last lines.
const LAST_LINES: usize = 6;

/// The latest run of a name.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    /// Name of the run.
    pub run: String,
    /// Process id.
    pub pid: u32,
    /// Start time of the process by the kernel's clock: process ids are reused.
    process_began: u64,
    /// When it was up (UTC): `2026-11-21T14:16:30.123Z`.
    pub started: String,
    /// Name of the blueprint.
    pub blueprint: String,
    /// Its log.
    pub log: Option<PathBuf>,
    /// Its text log; `None` if it wrote to its terminal.
    pub text_log: Option<PathBuf>,
    /// How it ended.
    pub end: Option<End>,
}

/// The end of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct End {
    /// Time (UTC), in the format of `started`.
    pub at: String,
    /// Its exit code.
    pub exit: u8,
    /// Reason.
    pub why: String,
    /// Problems during the shutdown: an arm that was not parked, for example.
    #[serde(default)]
    pub warnings: Vec<String>,
}

/// State of a recorded run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum RunState<'a> {
    /// It is live.
    Live,
    /// It ended and recorded its end.
    Ended(&'a End),
    /// Its process is gone without a recorded end.
    Crashed,
}

impl RunRecord {
    /// Records that a run of this process is up.
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

    /// Records its end.
    pub fn end(mut self, exit: Exit, why: String, warnings: Vec<String>) {
        self.end = Some(End { at: now(), exit: exit as u8, why, warnings });
        self.keep();
    }

    fn keep(&self) {
        let Some(folder) = files::log_folder() else { return };
        if let Err(error) = self.keep_in(&folder) {
            tracing::info!("cannot write the run's record: {}: {error}", folder.display());
        }
    }

    fn keep_in(&self, folder: &Path) -> io::Result<()> {
        std::fs::create_dir_all(folder)?;
        // Readers find the old record or the new one, never a partial one.
        let fresh = folder.join(format!(".{}.json.{}", self.run, self.pid));
        let written = std::fs::write(&fresh, serde_json::to_vec_pretty(self)?);
        let kept = written.and_then(|()| std::fs::rename(&fresh, path_in(folder, &self.run)));
        // A full disk keeps no part of it.
        kept.inspect_err(|_| drop(std::fs::remove_file(&fresh)))
    }

    /// Returns the record of a name.
    pub fn of(run: &str) -> Option<Self> {
        dimos_rpc::run_dir::check_name(run).ok()?;
        read(&path_in(&files::log_folder()?, run))
    }

    /// Returns all records, the oldest run first.
    pub fn all() -> Vec<Self> {
        let entries = files::log_folder().and_then(|folder| std::fs::read_dir(folder).ok());
        let mut all: Vec<Self> =
            entries.into_iter().flatten().filter_map(|entry| entry.ok().and_then(|e| read(&e.path()))).collect();
        all.sort_by(|a, b| a.started.cmp(&b.started));
        all
    }

    /// Returns its state.
    pub fn state(&self) -> RunState<'_> {
        match &self.end {
            Some(end) => RunState::Ended(end),
            None if process_began(self.pid) == Some(self.process_began) => RunState::Live,
            None => RunState::Crashed,
        }
    }

    /// Returns whether it ended abnormally: by a crash, a fault or the end of its log.
    pub fn ended_abnormally(&self) -> bool {
        match self.state() {
            RunState::Live => false,
            RunState::Ended(end) => [Exit::Fault as u8, Exit::Log as u8].contains(&end.exit),
            RunState::Crashed => true,
        }
    }

    /// Describes its end in a sentence without full stop; `None` if it is live.
    pub fn describe_end(&self) -> Option<String> {
        let (run, pid) = (&self.run, self.pid);
        match self.state() {
            RunState::Live => None,
            RunState::Ended(end) => Some(format!("{run} (pid {pid}) ended {}: {}", end.at, end.why)),
            RunState::Crashed => Some(format!("{run} (pid {pid}), up since {}, crashed", self.started)),
        }
    }

    /// Returns the last lines of its text log.
    pub fn last_words(&self) -> Vec<String> {
        self.text_log.as_deref().map(last_lines).unwrap_or_default()
    }

    /// Returns why a verb does not find a run of this name; `None` if no end of one is recorded. The name is free
    /// before the process has written its last lines: waits for them, at most [`LAST_LINES_LIMIT`].
    pub fn failure_of(run: &str) -> Option<Failure> {
        let deadline = Instant::now() + LAST_LINES_LIMIT;
        loop {
            let record = Self::of(run)?;
            if record.state() != RunState::Live || Instant::now() > deadline {
                return record.failure();
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// Returns why a verb cannot reach it; `None` if it is live.
    pub fn failure(&self) -> Option<Failure> {
        let mut what = format!("no live run is named {}: {}", self.run, self.describe_end()?);
        for line in self.last_words().iter().filter(|_| self.ended_abnormally()) {
            what += &format!("\n  {line}");
        }
        let hint = match &self.text_log {
            Some(_) => format!("its text log: dimos logs {}", self.run),
            None => format!("start it again: dimos run {} --name {}", self.blueprint, self.run),
        };
        // The name of a run that has ended as asked is one that no live run has.
        let exit = if self.ended_abnormally() { Exit::Failed } else { Exit::Usage };
        Some(Failure::new(exit, what).hint(hint))
    }
}

/// Returns an absolute path, for readers in another folder.
fn absolute(path: impl AsRef<Path>) -> PathBuf {
    std::path::absolute(path.as_ref()).unwrap_or_else(|_| path.as_ref().to_owned())
}

/// Returns the current time in a format that sorts chronologically.
fn now() -> String {
    format!("{:.3}", Timestamp::now())
}

fn path_in(folder: &Path, run: &str) -> PathBuf {
    folder.join(format!("{run}.json"))
}

/// Reads a record; `None` if there is none or it is not valid.
fn read(path: &Path) -> Option<RunRecord> {
    path.extension().filter(|ending| *ending == "json")?;
    serde_json::from_slice(&bounded::read(path, bounded::SMALL).ok()?).ok()
}

/// Returns the last lines of a text file; empty if it cannot be read.
pub fn last_lines(path: &Path) -> Vec<String> {
    let tail = || {
        let mut file = bounded::open(path)?;
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

/// Returns the start time of a process in ticks since boot; `None` if there is no such process, or only a zombie.
fn process_began(pid: u32) -> Option<u64> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The program's name is in parentheses and may contain anything.
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
    fn a_process_is_identified_by_its_pid_and_start_time() {
        let us = std::process::id();
        let began = process_began(us).unwrap();
        assert_eq!(record(us, began).state(), RunState::Live);
        assert_eq!(record(us, began + 1).state(), RunState::Crashed, "another process has the pid now");
        let mut child = std::process::Command::new("true").spawn().unwrap();
        let pid = child.id();
        child.wait().unwrap();
        assert_eq!(process_began(pid), None);
    }

    #[test]
    fn a_record_that_cannot_be_kept_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let blocking = path_in(folder.path(), "r");
        std::fs::create_dir(&blocking).unwrap();
        assert!(record(1, 0).keep_in(folder.path()).is_err());
        let left: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().path()).collect();
        assert_eq!(left, [blocking]);
    }

    #[test]
    fn only_abnormal_ends_count_as_failed() {
        let ended = |exit: Exit| {
            let end =
                End { at: "1970-01-01T00:00:00.000Z".into(), exit: exit as u8, why: "w".into(), warnings: Vec::new() };
            RunRecord { end: Some(end), ..record(1, 0) }
        };
        assert!(
            ended(Exit::Fault).ended_abnormally()
                && !ended(Exit::Terminated).ended_abnormally()
                && !ended(Exit::Ok).ended_abnormally()
        );
        assert_eq!(ended(Exit::Ok).describe_end().unwrap(), "r (pid 1) ended 1970-01-01T00:00:00.000Z: w");
        assert!(record(std::process::id(), 0).failure().unwrap().what.contains("crashed"));
    }

    #[test]
    fn last_lines_skips_blank_lines() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let text: String = (0..2000).map(|n| format!("line {n}\n\n")).collect();
        std::fs::write(file.path(), text).unwrap();
        let expected: Vec<String> = (1994..2000).map(|n| format!("line {n}")).collect();
        assert_eq!(last_lines(file.path()), expected);
        assert!(last_lines(Path::new("/nonexistent")).is_empty());
    }
}
