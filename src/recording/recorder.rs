//! The recorder thread: takes samples from the tick's ring and notes from everybody else, logs them, and hands
//! events on in words. The only thread that waits for the disk; nobody waits for it.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use thiserror::Error;

use super::log_writer::LogAttachment;
pub use super::notes::Note;
use super::notes::Noted;
use super::space::Megabytes;
use super::worker::Worker;
use crate::clock::{Clock, MonotonicClock, WallOffset};
use crate::telemetry::describe::{Described, Names};
use crate::telemetry::{Event, Sample};

/// How often the ring is emptied: half as often as the log is flushed, because each time costs a wake-up.
const DRAIN_EVERY: Duration = Duration::from_millis(50);
/// The same in the first second, so that a run's first state is on disk soon.
const DRAIN_EVERY_AT_FIRST: Duration = Duration::from_millis(2);
/// Room for the write buffer: more than what a run logs between two flushes.
const BUFFER: usize = 256 * 1024;

/// What to record, and where.
#[derive(Debug, Clone)]
pub struct RecorderConfig {
    /// The log file, which must not exist yet; its folder is made. `None` records nothing.
    pub path: Option<PathBuf>,
    /// Name of the run.
    pub run: String,
    /// Names of arms, joints and tasks, in the order of the tick's indices.
    pub names: Names,
    /// Frame of the joint states: the blueprint's `joint_state_frame_id`.
    pub frame_id: String,
    /// Files to put into the log, the blueprint first of all.
    pub attachments: Vec<LogAttachment>,
    /// More about the run, besides its name, arms, joints and tasks.
    pub metadata: BTreeMap<String, String>,
    /// Offset between monotonic and Unix time.
    pub wall: WallOffset,
    /// The log ends when less room than this is left on its disk [bytes].
    pub min_free: u64,
}

/// What the recorder tells while it runs, on its own thread: be quick.
#[derive(Debug)]
pub enum Notice<'a> {
    /// Something happened in the tick with this index.
    Event {
        /// Index of the tick.
        tick: u64,
        /// What happened.
        event: &'a Event,
        /// The same in words.
        described: &'a Described,
    },
    /// The recorder fell behind: so many samples are missing in the log.
    Lost(u32),
    /// The log ends here, before the run. Said once; events are still told.
    Stopped(&'a RecordError),
}

/// Why there is no log, or no more of it.
#[derive(Debug, Error)]
pub enum RecordError {
    /// The file or its folder cannot be made.
    #[error("the log {path} cannot be made: {source}\nhint: {}", hint(source))]
    Create {
        /// The log file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A write failed.
    #[error("the log {path} ends here: {reason}\nhint: see whether the disk is full; --no-record runs without a log")]
    Write {
        /// The log file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// The disk is nearly full.
    #[error(
        "the log {path}: only {free} are free on its disk, and {min_free} must be\n\
         hint: make room, name another file with --record FILE, or set recording.min_free; --no-record runs without a log"
    )]
    Room {
        /// The log file.
        path: PathBuf,
        /// What is free.
        free: Megabytes,
        /// What must be.
        min_free: Megabytes,
    },
    /// The file is not where it was.
    #[error(
        "the log {path} ends here: it was removed or replaced while it was written\nhint: keep logs out of folders that are cleaned up"
    )]
    Removed {
        /// The log file.
        path: PathBuf,
    },
    /// The thread cannot be started.
    #[error("the recorder thread cannot be started: {0}\nhint: see whether a limit on threads or memory is reached")]
    Thread(std::io::Error),
}

fn hint(source: &std::io::Error) -> &'static str {
    match source.kind() {
        std::io::ErrorKind::AlreadyExists => "a log is never overwritten: name another file, or remove it first",
        _ => "name another file with --record FILE, or run with --no-record",
    }
}

/// Figures of a running recorder.
#[derive(Debug, Default)]
pub struct RecorderStats {
    /// Messages logged.
    pub messages: AtomicU64,
    /// Length of the log [bytes].
    pub bytes: AtomicU64,
    /// Samples lost, because the recorder fell behind.
    pub dropped: AtomicU64,
    /// A write failed: there is no more log.
    pub failed: AtomicBool,
}

/// A running recorder. Dropping it closes the log.
#[derive(Debug)]
pub struct Recorder {
    path: Option<PathBuf>,
    stats: Arc<RecorderStats>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<Result<(), RecordError>>>,
}

impl Recorder {
    /// Begins the log and starts the thread `recorder`. Without a path the ring is emptied and events are told all
    /// the same.
    pub fn start(
        config: RecorderConfig,
        ring: rtrb::Consumer<Sample>,
        notes: Noted,
        on_notice: impl FnMut(Notice<'_>) + Send + 'static,
    ) -> Result<Self, RecordError> {
        let stats = Arc::new(RecorderStats::default());
        let file = config.path.as_deref().map(create_file).transpose()?;
        let disk = file.as_ref().and_then(|f| f.try_clone().ok());
        let sink = file.map(|f| Counted { inner: BufWriter::with_capacity(BUFFER, f), stats: stats.clone(), at: 0 });
        let mut worker = Worker::new(&config, sink, disk, ring, notes, on_notice, stats.clone())?;
        let stop = Arc::new(AtomicBool::new(false));
        let stopping = stop.clone();
        let thread = std::thread::Builder::new().name("recorder".into()).spawn(move || {
            let started = MonotonicClock.now();
            while !stopping.load(Ordering::Acquire) {
                let now = MonotonicClock.now();
                worker.step(now);
                let young = now.since(started) < Duration::from_secs(1);
                std::thread::park_timeout(if young { DRAIN_EVERY_AT_FIRST } else { DRAIN_EVERY });
            }
            worker.finish(MonotonicClock.now())
        });
        let thread = Some(thread.map_err(RecordError::Thread)?);
        Ok(Self { path: config.path, stats, stop, thread })
    }

    /// Where the log is.
    pub fn path(&self) -> Option<&Path> {
        self.path.as_deref()
    }

    /// Its figures, up to date at any time.
    pub fn stats(&self) -> Arc<RecorderStats> {
        self.stats.clone()
    }

    /// Takes what is left in the ring and closes the log. Call it when the tick has ended. The error is the one that
    /// ended the log, if one did.
    pub fn finish(mut self) -> Result<(), RecordError> {
        self.join()
    }

    fn join(&mut self) -> Result<(), RecordError> {
        self.stop.store(true, Ordering::Release);
        let Some(thread) = self.thread.take() else { return Ok(()) };
        thread.thread().unpark();
        let path = self.path.clone().unwrap_or_default();
        let panicked = |_| RecordError::Write { path, reason: "the recorder thread panicked".into() };
        thread.join().map_err(panicked).and_then(|result| result)
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        // Its error was told as `Notice::Stopped`, or there is nobody left to tell.
        let _ = self.join();
    }
}

fn create_file(path: &Path) -> Result<File, RecordError> {
    let make = || {
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder)?;
        }
        File::create_new(path)
    };
    make().map_err(|source| RecordError::Create { path: path.to_owned(), source })
}

/// A sink that counts what goes through it, and so knows where it is: a buffered file that is asked writes first what
/// it has, and asks the kernel.
struct Counted<W> {
    inner: W,
    stats: Arc<RecorderStats>,
    at: u64,
}

impl<W: Write> Write for Counted<W> {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let written = self.inner.write(bytes)?;
        self.stats.bytes.fetch_add(written as u64, Ordering::Relaxed);
        self.at += written as u64;
        Ok(written)
    }
    fn flush(&mut self) -> std::io::Result<()> {
        self.inner.flush()
    }
}

impl<W: Seek> Seek for Counted<W> {
    fn seek(&mut self, to: SeekFrom) -> std::io::Result<u64> {
        if to != SeekFrom::Current(0) {
            self.at = self.inner.seek(to)?;
        }
        Ok(self.at)
    }
}
