//! The steps of the recorder thread.

mod faults;

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Seek, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use mcap::{McapError, McapResult};

use super::arm_messages::{io, joint_status, payload};
use super::askers::Askers;
use super::disk_sync::DiskSync;
use super::fault_ring::{AFTER, FaultRing};
use super::log_writer::{LogWriter, Topics};
use super::notes::NoteReceiver;
use super::pending_executes::{Execute, PendingExecutes};
use super::recorder::{Note, Notice, RecordError, RecorderConfig, RecorderStats};
use super::rewrite::PART_OF;
use super::storage::FaultLog;
use super::tick_log::TickLog;
use super::{PART, disk_space, files};
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_core::telemetry::describe::{Described, Severity, describe};
use dimos_core::telemetry::{Event, Outcome, Sample, TickSample};

/// Longest wait for the disk at the end: a run ends soon after Ctrl-C, whatever its disk does.
const LAST_SYNC: Duration = Duration::from_secs(2);
/// Period of checking the disk's free space and the log file.
const WATCH_EVERY: Duration = Duration::from_millis(500);

/// Turns samples and notes into log and notices. Tests step it with their own clock.
pub(super) struct Worker<W: Write + Seek, F, O> {
    config: RecorderConfig,
    /// Creates a file, and returns a second handle of it, for its free space.
    open: O,
    /// The current file of the log.
    path: PathBuf,
    /// Its number in the log, from 0.
    part: u32,
    /// Bytes before its first message, of all files, and deadline of its first tick.
    began: (u64, Option<Mono>),
    topics: Topics,
    log: Option<LogWriter<W>>,
    disk: Option<File>,
    sync: Option<DiskSync>,
    synced: Mono,
    watched: Mono,
    ticks: TickLog,
    ring: rtrb::Consumer<Sample>,
    notes: NoteReceiver,
    /// Trajectory requests that the tick has not answered yet.
    executes: PendingExecutes,
    /// The latest inputs and outputs, and the latest load, of each arm.
    latest: BTreeMap<(bool, u16), Note>,
    askers: Askers,
    /// What is kept of a run without a log.
    faults: Option<(FaultLog, FaultRing)>,
    /// End of the log of a fault; the end of time until the tick with the fault is closed.
    until: Option<Mono>,
    /// Whether the current tick has a fault.
    faulted: bool,
    on_notice: F,
    stats: Arc<RecorderStats>,
    /// Messages in the earlier files of the log.
    earlier: u64,
    ended: Option<RecordError>,
}

impl<W, F, O> Worker<W, F, O>
where
    W: Write + Seek,
    F: FnMut(Notice<'_>),
    O: FnMut(&Path) -> Result<(W, Option<File>), RecordError>,
{
    pub(super) fn new(
        config: RecorderConfig,
        open: O,
        ring: rtrb::Consumer<Sample>,
        notes: NoteReceiver,
        on_notice: F,
        stats: Arc<RecorderStats>,
    ) -> Result<Self, RecordError> {
        let mut ticks = TickLog::new(config.run.clone(), config.names.clone(), config.frame_id.clone(), config.wall);
        ticks.tcps = config.tcps.clone();
        let path = config.path.clone();
        let faults = config.storage.fault_log.clone().filter(|_| path.is_none());
        let mut worker = Self {
            config,
            open,
            path: PathBuf::new(),
            part: 0,
            began: (0, None),
            topics: Topics::new(),
            log: None,
            disk: None,
            sync: None,
            synced: Mono::ZERO,
            watched: Mono::ZERO,
            ticks,
            ring,
            notes,
            executes: PendingExecutes::default(),
            latest: BTreeMap::new(),
            askers: Askers::default(),
            faults: faults.map(|faults| (faults.clone(), FaultRing::new())),
            until: None,
            faulted: false,
            on_notice,
            stats,
            earlier: 0,
            ended: None,
        };
        if let Some(path) = path {
            worker.begin(path, Mono::ZERO, BTreeMap::new())?;
        }
        Ok(worker)
    }

    /// Opens a file of the log. It begins with what it needs to be understood alone, at this time.
    fn begin(&mut self, path: PathBuf, stamp: Mono, more: BTreeMap<String, String>) -> Result<(), RecordError> {
        let (sink, disk) = (self.open)(&path)?;
        self.path = path;
        let storage = &self.config.storage;
        let own = disk.as_ref().filter(|_| storage.sync_every.is_some());
        let sync = own.map(|file| file.try_clone().and_then(DiskSync::start)).transpose();
        (self.disk, self.sync) = (disk, sync.map_err(RecordError::Thread)?);
        let mut metadata = self.config.metadata.clone();
        metadata.extend(self.ticks.metadata().into_iter().chain(more));
        let now = self.config.wall.wall(MonotonicClock.now());
        let create = || {
            let mut log = LogWriter::create_with(sink, now, &self.config.attachments, metadata, storage.compress)?;
            self.path.parent().into_iter().for_each(|folder| log.keep_indexes_in(folder));
            log.announce_all(&self.topics)?;
            self.ticks.announce(&mut log)?;
            self.ticks.renew(&mut log, stamp)?;
            Ok(log)
        };
        self.log = Some(create().map_err(|e| write_error(&self.path, &e))?);
        self.began = (self.stats.bytes.load(Ordering::Relaxed), None);
        let mut latest: Vec<Note> = self.latest.values().cloned().collect();
        for note in &mut latest {
            if let Note::Io { stamp: at, .. } | Note::Payload { stamp: at, .. } = note {
                *at = stamp;
            }
        }
        latest.into_iter().try_for_each(|note| self.note(note)).map_err(|e| write_error(&self.path, &e))
    }

    /// Takes all pending samples and notes and logs them.
    pub(super) fn step(&mut self, now: Mono) {
        // Counted before the notes are taken: a request is noted before it is passed to the tick, so the note of every
        // request that these samples answer is present, and is logged before the answer.
        let waiting = self.ring.slots();
        let notes = self.notes.take();
        let lost = self.notes.lost();
        if lost > 0 {
            self.stats.dropped.fetch_add(lost, Ordering::Relaxed);
            (self.on_notice)(Notice::Lost(lost.min(u64::from(u32::MAX)) as u32));
        }
        let samples: Vec<Sample> = self.ring.read_chunk(waiting).into_iter().flatten().collect();
        notes.iter().for_each(|note| self.askers.know(note));
        // Events are reported before any disk access.
        let fault = self.report_events(&samples);
        let done = if self.log.is_none() && self.faults.is_some() {
            self.keep(notes, samples);
            if fault { self.log_fault() } else { Ok(()) }
        } else {
            self.write(notes, &samples, now)
        };
        if let Err(e) = done {
            self.stop_log(e);
        } else if now.since(self.watched) >= WATCH_EVERY {
            self.watched = now;
            self.watch();
        }
    }

    /// Ends the log while there is space to close it, or when the file is gone.
    fn watch(&mut self) {
        let Some((file, _)) = self.disk.as_ref().zip(self.log.as_ref()) else { return };
        let Err(reason) = disk_space::watch(&self.path, file, self.config.storage.min_free) else { return };
        let closed = self.log.take().map(|log| log.finish().map(drop)).transpose();
        // A full disk is the more important error.
        self.stop_log(closed.map_or_else(|e| write_error(&self.path, &e), |_| reason));
    }

    fn described(&mut self, tick: u64, event: &Event, later: &[Sample]) -> Described {
        Described { by: self.askers.of(tick, event, later), ..describe(event, &self.config.names) }
    }

    /// Reports the events among samples. Returns whether there is a fault.
    fn report_events(&mut self, samples: &[Sample]) -> bool {
        let mut fault = false;
        for (n, sample) in samples.iter().enumerate() {
            if let Sample::Event(tick, event) = sample {
                let later = samples.get(n + 1..).unwrap_or_default();
                let described = self.described(*tick, event, later);
                fault |= described.severity == Severity::Error;
                (self.on_notice)(Notice::Event { tick: *tick, event, described: &described });
            }
        }
        fault
    }

    fn write(&mut self, notes: Vec<Note>, samples: &[Sample], now: Mono) -> Result<(), RecordError> {
        self.put(notes, samples)?;
        let Some(log) = &mut self.log else { return Ok(()) };
        let mut flush = || {
            let due = self.config.storage.sync_every.is_some_and(|every| now.since(self.synced) >= every);
            if log.flush_if_due(now)? && due {
                self.sync.as_ref().map_or(Ok(()), DiskSync::request)?;
                self.synced = now;
            }
            Ok(())
        };
        flush().map_err(|e| write_error(&self.path, &e))?;
        self.stats.messages.store(self.earlier + log.written(), Ordering::Relaxed);
        Ok(())
    }

    fn put(&mut self, notes: Vec<Note>, samples: &[Sample]) -> Result<(), RecordError> {
        for note in notes {
            self.note(note).map_err(|e| write_error(&self.path, &e))?;
        }
        for (n, sample) in samples.iter().enumerate() {
            match sample {
                Sample::Arm(arm) => self.ticks.arm(*arm),
                Sample::Event(tick, event) => {
                    if let Event::Request(id, outcome) = event {
                        self.answered(*id, outcome).map_err(|e| write_error(&self.path, &e))?;
                    }
                    let later = samples.get(n + 1..).unwrap_or_default();
                    let described = self.described(*tick, event, later);
                    self.faulted |= described.severity == Severity::Error;
                    self.ticks.event(*tick, Some(described));
                }
                Sample::Tick(tick) => {
                    self.close(tick).map_err(|e| write_error(&self.path, &e))?;
                    self.closed(tick.deadline)?;
                }
            }
        }
        Ok(())
    }

    /// After a tick: the log of a fault ends, or a long log continues in another file.
    fn closed(&mut self, deadline: Mono) -> Result<(), RecordError> {
        if self.log.is_none() {
            return Ok(());
        }
        if let Some(until) = self.until {
            let until = if std::mem::take(&mut self.faulted) { deadline.after(AFTER) } else { until };
            self.until = Some(until);
            if deadline >= until {
                self.end_fault()?;
                // Its thread syncs it once more.
                self.sync = None;
            }
            return Ok(());
        }
        let (storage, first) = (&self.config.storage, *self.began.1.get_or_insert(deadline));
        let size = self.stats.bytes.load(Ordering::Relaxed) - self.began.0;
        let due = storage.split_size.is_some_and(|most| size >= most)
            || storage.split_after.is_some_and(|most| deadline.since(first) >= most);
        if due { self.split(deadline) } else { Ok(()) }
    }

    /// Continues in another file.
    fn split(&mut self, deadline: Mono) -> Result<(), RecordError> {
        let Some((mut log, first)) = self.log.take().zip(self.config.path.clone()) else { return Ok(()) };
        self.topics.clone_from(log.topics());
        self.part += 1;
        self.earlier += log.written();
        let next = files::part(&first, self.part);
        let name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let finished = log.continues_in(name(&next)).and_then(|()| log.finish());
        finished.map_err(|e| write_error(&self.path, &e))?;
        // Its thread syncs it once more.
        self.sync = None;
        let more = BTreeMap::from([(PART.to_owned(), self.part.to_string()), (PART_OF.to_owned(), name(&first))]);
        self.begin(next, deadline, more)
    }

    /// Takes from a note what every file begins with.
    fn know(&mut self, note: &Note) {
        match note {
            Note::Io { arm, .. } => drop(self.latest.insert((false, *arm), note.clone())),
            Note::Payload { arm, .. } => drop(self.latest.insert((true, *arm), note.clone())),
            Note::Markers { markers, .. } => self.ticks.objects(markers),
            Note::Robots { robots, description, .. } => self.ticks.robots(robots.clone(), description.clone()),
            Note::ArmText { arm, text } => self.ticks.arm_text(*arm, text.clone()),
            _ => {}
        }
    }

    fn note(&mut self, note: Note) -> McapResult<()> {
        self.know(&note);
        let Some(log) = &mut self.log else { return Ok(()) };
        match note {
            Note::Request { id, stamp, origin, json } => self.ticks.request(log, (id, stamp, origin), &json),
            Note::Execute { id, stamp, origin, task, motion, trajectory, until } => {
                match self.executes.asked(id, Execute { stamp, origin, task, motion, trajectory, until }) {
                    Some((id, execute)) => {
                        self.ticks.request(log, (id, execute.stamp, execute.origin), &execute.whole())
                    }
                    None => Ok(()),
                }
            }
            Note::Log { severity, stamp, text } => self.ticks.line(log, severity, stamp, &text),
            Note::Io { arm, stamp, info, state } => {
                self.ticks.part(log, arm, "io", stamp, |header, _| io(header, &info, &state))
            }
            Note::JointStatus { arm, stamp, joints } => {
                self.ticks.part(log, arm, "joint_status", stamp, |header, names| joint_status(header, names, &*joints))
            }
            Note::Payload { arm, stamp, load } => {
                self.ticks.part(log, arm, "payload", stamp, |header, _| payload(header, &load))
            }
            Note::Robots { stamp, .. } => self.ticks.latched(log, stamp),
            Note::Markers { stamp, markers } => self.ticks.markers(log, stamp, markers),
            Note::ArmText { .. } | Note::Asked { .. } => Ok(()),
        }
    }

    /// Handles a request's answer: a trajectory request is logged now.
    fn answered(&mut self, id: u64, outcome: &Outcome) -> McapResult<()> {
        let Some((log, execute)) = self.log.as_mut().zip(self.executes.answered(id)) else { return Ok(()) };
        let taken_on = matches!(outcome, Outcome::Accepted);
        let json = if taken_on { execute.whole() } else { execute.refused() };
        self.ticks.request(log, (id, execute.stamp, execute.origin), &json)?;
        if taken_on {
            self.ticks.motion(log, execute.stamp, execute.task, &execute.trajectory)?;
        }
        Ok(())
    }

    fn close(&mut self, tick: &TickSample) -> McapResult<()> {
        let (lost, result) = match self.log.as_mut().map(|log| self.ticks.close(log, tick)) {
            Some(Ok(lost)) => (lost, Ok(())),
            Some(Err(e)) => (tick.dropped, Err(e)),
            None => {
                self.ticks.clear();
                (tick.dropped, Ok(()))
            }
        };
        if lost > 0 {
            self.stats.dropped.fetch_add(u64::from(lost), Ordering::Relaxed);
            (self.on_notice)(Notice::Lost(lost));
        }
        result
    }

    /// Ends the log after an error. That of a fault ends alone: its run continues.
    fn stop_log(&mut self, error: RecordError) {
        self.log = None;
        if self.faults.is_some() {
            (self.until, self.sync) = (None, None);
            (self.on_notice)(Notice::Fault(Err(&error)));
            return;
        }
        self.stats.failed.store(true, Ordering::Relaxed);
        (self.on_notice)(Notice::Stopped(&error));
        self.ended = Some(error);
    }

    /// Takes the rest and closes the log.
    pub(super) fn finish(mut self, now: Mono) -> Result<(), RecordError> {
        self.step(now);
        for (id, execute) in std::mem::take(&mut self.executes).into_unanswered() {
            if let Some(log) = &mut self.log
                && let Err(e) = self.ticks.request(log, (id, execute.stamp, execute.origin), &execute.whole())
            {
                self.stop_log(write_error(&self.path, &e));
            }
        }
        self.watch();
        if self.faults.is_some() {
            if let Err(e) = self.end_fault() {
                self.stop_log(e);
            }
            if let Some(Ok(false)) = self.sync.take().map(|sync| sync.finish(LAST_SYNC)) {
                (self.on_notice)(Notice::Unsynced(LAST_SYNC));
            }
            return Ok(());
        }
        let Some(log) = self.log.take() else { return self.ended.map_or(Ok(()), Err) };
        let sync = self.sync.take();
        let synced = log.finish().and_then(|_| Ok(sync.map_or(Ok(true), |sync| sync.finish(LAST_SYNC))?));
        match synced {
            Ok(true) => Ok(()),
            Ok(false) => {
                (self.on_notice)(Notice::Unsynced(LAST_SYNC));
                Ok(())
            }
            Err(e) => {
                self.stop_log(write_error(&self.path, &e));
                Err(write_error(&self.path, &e))
            }
        }
    }
}

fn write_error(path: &Path, e: &McapError) -> RecordError {
    let reason = if let McapError::Io(e) = e { e.to_string() } else { e.to_string() };
    RecordError::Write { path: path.to_owned(), reason }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::notes::channel;
    use dimos_core::clock::WallOffset;
    use dimos_core::telemetry::describe::Names;
    use std::collections::BTreeMap;
    use std::io::{Cursor, Error, ErrorKind, SeekFrom};
    use std::sync::Mutex;

    /// A disk with little space left.
    struct Full {
        inner: Cursor<Vec<u8>>,
        room: usize,
    }

    impl Write for Full {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            if self.inner.get_ref().len() + bytes.len() > self.room {
                return Err(Error::new(ErrorKind::StorageFull, "No space left on device"));
            }
            self.inner.write(bytes)
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    impl Seek for Full {
        fn seek(&mut self, to: SeekFrom) -> std::io::Result<u64> {
            self.inner.seek(to)
        }
    }

    #[test]
    fn a_full_disk_ends_the_log_once_and_the_ring_is_still_emptied() {
        let (mut producer, ring) = rtrb::RingBuffer::new(64);
        let (_notes, receiver) = channel();
        let config = RecorderConfig {
            path: Some("run.mcap".into()),
            run: "run".into(),
            names: Names::default(),
            frame_id: String::new(),
            attachments: Vec::new(),
            metadata: BTreeMap::new(),
            tcps: Default::default(),
            wall: WallOffset::of(Mono::ZERO, 0),
            storage: Default::default(),
        };
        let notices = Arc::new(Mutex::new(Vec::new()));
        let sink = notices.clone();
        let on_notice = move |n: Notice<'_>| match n {
            Notice::Stopped(e) => sink.lock().unwrap().push(e.to_string()),
            Notice::Event { described, .. } => sink.lock().unwrap().push(described.kind.to_owned()),
            Notice::Lost(_) | Notice::Unsynced(_) | Notice::Fault(_) => {}
        };
        let stats = Arc::new(RecorderStats::default());
        let open = |_: &Path| Ok((Full { inner: Cursor::new(Vec::new()), room: 4000 }, None));
        let mut worker = Worker::new(config, open, ring, receiver, on_notice, stats.clone()).unwrap();
        for tick in 0..40 {
            let sample = TickSample { tick, ..TickSample::default() };
            producer.push(Sample::Tick(sample)).unwrap();
            worker.step(Mono(1_000_000_000 * (tick + 1)));
        }
        producer.push(Sample::Event(40, Event::Degraded)).unwrap();
        worker.step(Mono(1_000_000_000 * 41));
        assert_eq!(producer.slots(), 64);
        assert!(stats.failed.load(Ordering::Relaxed));
        let message = "the log run.mcap ends here: No space left on device\n\
                       hint: check whether the disk is full; --no-record runs without a log";
        assert_eq!(*notices.lock().unwrap(), [message, "degraded"]);
        assert_eq!(worker.finish(Mono(1)).unwrap_err().to_string(), message);
    }
}
