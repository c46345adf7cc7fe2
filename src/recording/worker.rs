//! The steps of the recorder thread.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{Seek, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use mcap::{McapError, McapResult};

use super::arm_messages::{io, joint_status, payload};
use super::disk_space;
use super::disk_sync::DiskSync;
use super::log_writer::LogWriter;
use super::notes::NoteReceiver;
use super::pending_executes::{Execute, PendingExecutes};
use super::recorder::{Note, Notice, RecordError, RecorderConfig, RecorderStats};
use super::tick_log::TickLog;
use crate::clock::{Clock, Mono, MonotonicClock};
use crate::telemetry::describe::{Described, Names, describe};
use crate::telemetry::{Event, Outcome, Sample, TickSample};

/// Period of syncing the file to disk, against a loss of power.
const SYNC_EVERY: Duration = Duration::from_secs(1);
/// Longest wait for the disk at the end: a run ends soon after Ctrl-C, whatever its disk does.
const LAST_SYNC: Duration = Duration::from_secs(2);
/// Period of checking the disk's free space and the log file.
const WATCH_EVERY: Duration = Duration::from_millis(500);

/// Turns samples and notes into log and notices. Tests step it with their own clock.
pub(super) struct Worker<W: Write + Seek, F> {
    path: PathBuf,
    log: Option<LogWriter<W>>,
    /// A second handle of the file, for its free space.
    disk: Option<File>,
    sync: Option<DiskSync>,
    synced: Mono,
    min_free: u64,
    watched: Mono,
    ticks: TickLog,
    names: Names,
    ring: rtrb::Consumer<Sample>,
    notes: NoteReceiver,
    /// Trajectory requests that the tick has not answered yet.
    executes: PendingExecutes,
    on_notice: F,
    stats: Arc<RecorderStats>,
    ended: Option<RecordError>,
}

impl<W: Write + Seek, F: FnMut(Notice<'_>)> Worker<W, F> {
    pub(super) fn new(
        config: &RecorderConfig,
        sink: Option<W>,
        disk: Option<File>,
        ring: rtrb::Consumer<Sample>,
        notes: NoteReceiver,
        on_notice: F,
        stats: Arc<RecorderStats>,
    ) -> Result<Self, RecordError> {
        let names = config.names.clone();
        let mut ticks = TickLog::new(config.run.clone(), names.clone(), config.frame_id.clone(), config.wall);
        ticks.tcps = config.tcps.clone();
        let begin = |sink| {
            let mut metadata = config.metadata.clone();
            metadata.extend(ticks.metadata());
            let now = config.wall.wall(MonotonicClock.now());
            let mut log = LogWriter::create(sink, now, &config.attachments, metadata)?;
            ticks.announce(&mut log)?;
            Ok(log)
        };
        let path = config.path.clone().unwrap_or_default();
        let sync = disk.as_ref().map(|file| file.try_clone().and_then(DiskSync::start));
        let sync = sync.transpose().map_err(RecordError::Thread)?;
        let log = sink.map(begin).transpose().map_err(|e| write_error(&path, &e))?;
        Ok(Self {
            path,
            log,
            disk,
            sync,
            synced: Mono::ZERO,
            min_free: config.min_free,
            watched: Mono::ZERO,
            ticks,
            names,
            ring,
            notes,
            executes: PendingExecutes::default(),
            on_notice,
            stats,
            ended: None,
        })
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
        // Events are reported before any disk access.
        let mut described = self.report_events(&samples);
        if let Err(e) = self.write(notes, &samples, &mut described, now) {
            self.stop_log(write_error(&self.path, &e));
        } else if now.since(self.watched) >= WATCH_EVERY {
            self.watched = now;
            self.watch();
        }
    }

    /// Ends the log while there is space to close it, or when the file is gone.
    fn watch(&mut self) {
        let Some((file, _)) = self.disk.as_ref().zip(self.log.as_ref()) else { return };
        let Err(reason) = disk_space::watch(&self.path, file, self.min_free) else { return };
        let closed = self.log.take().map(|log| log.finish().map(drop)).transpose();
        // A full disk is the more important error.
        self.stop_log(closed.map_or_else(|e| write_error(&self.path, &e), |_| reason));
    }

    fn report_events(&mut self, samples: &[Sample]) -> VecDeque<Described> {
        let mut all = VecDeque::new();
        for sample in samples {
            if let Sample::Event(tick, event) = sample {
                let described = describe(event, &self.names);
                (self.on_notice)(Notice::Event { tick: *tick, event, described: &described });
                all.push_back(described);
            }
        }
        all
    }

    fn write(
        &mut self,
        notes: Vec<Note>,
        samples: &[Sample],
        described: &mut VecDeque<Described>,
        now: Mono,
    ) -> McapResult<()> {
        for note in notes {
            self.note(note)?;
        }
        for sample in samples {
            match sample {
                Sample::Arm(arm) => self.ticks.arm(*arm),
                Sample::Event(tick, event) => {
                    if let Event::Request(id, outcome) = event {
                        self.answered(*id, outcome)?;
                    }
                    self.ticks.event(*tick, described.pop_front());
                }
                Sample::Tick(tick) => self.close(tick)?,
            }
        }
        let Some(log) = &mut self.log else { return Ok(()) };
        if log.flush_if_due(now)? && now.since(self.synced) >= SYNC_EVERY {
            self.sync.as_ref().map_or(Ok(()), DiskSync::request)?;
            self.synced = now;
        }
        self.stats.messages.store(log.written(), Ordering::Relaxed);
        Ok(())
    }

    fn note(&mut self, note: Note) -> McapResult<()> {
        let Some(log) = &mut self.log else { return Ok(()) };
        match note {
            Note::Request { id, stamp, json } => self.ticks.request(log, id, stamp, &json),
            Note::Execute { id, stamp, task, motion, trajectory } => {
                match self.executes.asked(id, Execute { stamp, task, motion, trajectory }) {
                    Some((id, execute)) => self.ticks.request(log, id, execute.stamp, &execute.whole()),
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
            Note::Robots { stamp, robots, description } => self.ticks.robots(log, stamp, robots, description),
            Note::Markers { stamp, markers } => self.ticks.markers(log, stamp, markers),
            Note::ArmText { arm, text } => {
                self.ticks.arm_text(arm, text);
                Ok(())
            }
        }
    }

    /// Handles a request's answer: a trajectory request is logged now.
    fn answered(&mut self, id: u64, outcome: &Outcome) -> McapResult<()> {
        let Some((log, execute)) = self.log.as_mut().zip(self.executes.answered(id)) else { return Ok(()) };
        let taken_on = matches!(outcome, Outcome::Accepted);
        let json = if taken_on { execute.whole() } else { execute.refused() };
        self.ticks.request(log, id, execute.stamp, &json)?;
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

    fn stop_log(&mut self, error: RecordError) {
        self.log = None;
        self.stats.failed.store(true, Ordering::Relaxed);
        (self.on_notice)(Notice::Stopped(&error));
        self.ended = Some(error);
    }

    /// Takes the rest and closes the log.
    pub(super) fn finish(mut self, now: Mono) -> Result<(), RecordError> {
        self.step(now);
        for (id, execute) in std::mem::take(&mut self.executes).into_unanswered() {
            if let Some(log) = &mut self.log
                && let Err(e) = self.ticks.request(log, id, execute.stamp, &execute.whole())
            {
                self.stop_log(write_error(&self.path, &e));
            }
        }
        self.watch();
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
    use crate::clock::WallOffset;
    use crate::recording::notes::channel;
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
            min_free: 0,
        };
        let notices = Arc::new(Mutex::new(Vec::new()));
        let sink = notices.clone();
        let on_notice = move |n: Notice<'_>| match n {
            Notice::Stopped(e) => sink.lock().unwrap().push(e.to_string()),
            Notice::Event { described, .. } => sink.lock().unwrap().push(described.kind.to_owned()),
            Notice::Lost(_) | Notice::Unsynced(_) => {}
        };
        let stats = Arc::new(RecorderStats::default());
        let disk = Full { inner: Cursor::new(Vec::new()), room: 4000 };
        let mut worker = Worker::new(&config, Some(disk), None, ring, receiver, on_notice, stats.clone()).unwrap();
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
