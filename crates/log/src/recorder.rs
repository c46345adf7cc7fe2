//! The recorder thread: takes samples from the tick's ring and notes from other threads, logs them, and passes events
//! on as text. It writes to the kernel's page cache; a thread beside it waits for the disk.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use thiserror::Error;

use super::disk_space::Megabytes;
use super::files;
use super::log_writer::LogAttachment;
pub use super::notes::Note;
use super::notes::NoteReceiver;
use super::storage::Storage;
use super::tcp_log::TcpChains;
use super::worker::Worker;
use dimos_core::clock::{Clock, MonotonicClock, WallOffset};
use dimos_core::telemetry::describe::{Described, Names};
use dimos_core::telemetry::{Event, Sample};

/// Period at which the ring is emptied: half the flush period, because each wake-up has a cost.
const DRAIN_EVERY: Duration = Duration::from_millis(50);
/// Period during the first second, so that a run's first state is on disk soon.
const DRAIN_EVERY_AT_FIRST: Duration = Duration::from_millis(2);
/// Size of the write buffer [bytes]: more than a run logs between two flushes.
const BUFFER: usize = 256 * 1024;

/// What to record, and where.
#[derive(Debug, Clone)]
pub struct RecorderConfig {
    /// The log file, which must not exist yet; its folder is created. `None` records nothing.
    pub path: Option<PathBuf>,
    /// Name of the run.
    pub run: String,
    /// Names of arms, joints and tasks, in the order of the tick's indices.
    pub names: Names,
    /// Frame of the joint states: the blueprint's `joint_state_frame_id`.
    pub frame_id: String,
    /// Files to attach, the blueprint first.
    pub attachments: Vec<LogAttachment>,
    /// Further metadata, besides name, arms, joints and tasks.
    pub metadata: BTreeMap<String, String>,
    /// Models of the arms' tool centre points.
    pub tcps: TcpChains,
    /// Offset between monotonic and Unix time.
    pub wall: WallOffset,
    /// How it is stored.
    pub storage: Storage,
}

/// Notices of the recorder, delivered on its thread: handlers must be fast.
#[derive(Debug)]
pub enum Notice<'a> {
    /// An event of a tick.
    Event {
        /// Index of the tick.
        tick: u64,
        /// The event.
        event: &'a Event,
        /// The event as text.
        described: &'a Described,
    },
    /// The recorder fell behind: number of samples missing in the log.
    Lost(u32),
    /// The log ends before the run. Reported once; events are still reported.
    Stopped(&'a RecordError),
    /// The log is closed, but the disk did not store all of it in this time.
    Unsynced(Duration),
    /// The log of a fault, of a run that is not recorded, is complete, or why there is none.
    Fault(Result<&'a Path, &'a RecordError>),
}

/// Why there is no log, or why it ended early.
#[derive(Debug, Error)]
pub enum RecordError {
    /// The file or its folder cannot be created.
    #[error("cannot create the log {path}: {source}\nhint: {}", hint(source))]
    Create {
        /// The log file.
        path: PathBuf,
        /// The error.
        source: std::io::Error,
    },
    /// A write failed.
    #[error("the log {path} ends here: {reason}\nhint: check whether the disk is full; --no-record runs without a log")]
    Write {
        /// The log file.
        path: PathBuf,
        /// The error.
        reason: String,
    },
    /// The disk is nearly full.
    #[error(
        "the log {path}: {free} free on its disk (minimum {min_free})\n\
         hint: free some space, choose another file with --record FILE, or set recording.min_free; --no-record runs without a log"
    )]
    Room {
        /// The log file.
        path: PathBuf,
        /// Free space.
        free: Megabytes,
        /// Minimum free space.
        min_free: Megabytes,
    },
    /// The file was moved or removed.
    #[error(
        "the log {path} ends here: it was removed or replaced while it was being written\nhint: do not log to folders that are cleaned up automatically"
    )]
    Removed {
        /// The log file.
        path: PathBuf,
    },
    /// The thread cannot be started.
    #[error("cannot start the recorder thread: {0}\nhint: check the limits on threads and memory")]
    Thread(std::io::Error),
}

fn hint(source: &std::io::Error) -> &'static str {
    match source.kind() {
        std::io::ErrorKind::AlreadyExists => "a log is never overwritten: choose another file name, or remove the file",
        _ => "choose another file with --record FILE, or run with --no-record",
    }
}

/// Statistics of a running recorder.
#[derive(Debug, Default)]
pub struct RecorderStats {
    /// Messages logged.
    pub messages: AtomicU64,
    /// Length of the log [bytes].
    pub bytes: AtomicU64,
    /// Samples lost because the recorder fell behind.
    pub dropped: AtomicU64,
    /// A write failed: the log has ended.
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
    /// Creates the log and starts the thread `recorder`. Without a path it still empties the ring and reports events.
    pub fn start(
        config: RecorderConfig,
        ring: rtrb::Consumer<Sample>,
        notes: NoteReceiver,
        on_notice: impl FnMut(Notice<'_>) + Send + 'static,
    ) -> Result<Self, RecordError> {
        let stats = Arc::new(RecorderStats::default());
        let (path, counted) = (config.path.clone(), stats.clone());
        let open = move |path: &Path| {
            let file = create_file(path)?;
            let disk = file.try_clone().ok();
            let inner = BufWriter::with_capacity(BUFFER, file);
            Ok((Counted { inner, stats: counted.clone(), at: 0 }, disk))
        };
        let mut worker = Worker::new(config, open, ring, notes, on_notice, stats.clone())?;
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
        Ok(Self { path, stats, stop, thread })
    }

    /// Returns the path of the log.
    pub fn path(&self) -> Option<&Path> {
        self.path.as_deref()
    }

    /// Returns live statistics.
    pub fn stats(&self) -> Arc<RecorderStats> {
        self.stats.clone()
    }

    /// Lets the thread take what waits now, instead of within 50 ms.
    pub fn wake(&self) {
        self.thread.iter().for_each(|thread| thread.thread().unpark());
    }

    /// Takes the remaining samples and closes the log. Call it after the tick has ended. Returns the error that ended
    /// the log, if any.
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
        // The error was reported as `Notice::Stopped`, or there is no receiver left.
        let _ = self.join();
    }
}

fn create_file(path: &Path) -> Result<File, RecordError> {
    let make = || -> std::io::Result<File> {
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder)?;
        }
        let file = File::create_new(path)?;
        files::mark_as_being_written(&file);
        Ok(file)
    };
    make().map_err(|source| RecordError::Create { path: path.to_owned(), source })
}

/// A sink that counts bytes and so knows its position: asking a buffered file for it would flush the buffer and call
/// the kernel.
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
