//! Reads a log: its decoded messages in order of time, up to a cut.

use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};

use mcap::parse_record;
use mcap::records::{Record, op};

use super::entries::{Channels, message};
use super::records::{RawRecord, RecordReader, chunk_header, unpack_chunk};
use super::{PART, files};

pub use super::entries::{Entry, Payload};
pub use super::records::ReplayError;

/// Which messages to read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Selection {
    /// Topics; empty for all.
    pub topics: Vec<String>,
    /// First Unix time [ns].
    pub from: u64,
    /// Last Unix time, inclusive [ns].
    pub to: u64,
}

impl Default for Selection {
    fn default() -> Self {
        Self { topics: Vec::new(), from: 0, to: u64::MAX }
    }
}

/// Information about a log.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LogInfo {
    /// Unix times of its first and last message [ns]; `None` without messages.
    pub span: Option<(u64, u64)>,
    /// Whether the log was closed properly.
    pub complete: bool,
    /// Whether a live run was still writing it when it was opened: what it had written by then is read.
    pub live: bool,
    /// Metadata of the run: `run`, `version`, `arms`, `tasks`, `wall_offset_ns` and more.
    pub metadata: BTreeMap<String, String>,
    /// Topics and their schemas.
    pub topics: BTreeMap<String, String>,
}

/// A log opened for reading: of one in several files all of them, if it is opened by the first.
pub struct LogReader {
    /// Files after the first, with their first and last times.
    parts: Vec<(PathBuf, (u64, u64))>,
    first: PathBuf,
    /// The file that is read; 0 is the first.
    part: usize,
    topics: Option<Vec<String>>,
    records: RecordReader,
    selection: Selection,
    info: LogInfo,
    channels: Channels,
    /// Latest time and position of each chunk of a closed log.
    index: Vec<(u64, u64)>,
    ready: VecDeque<Entry>,
    failed: Option<ReplayError>,
    lost: u64,
}

impl LogReader {
    /// Opens a log. Uses the summary of a closed log; scans a truncated one to find its end.
    pub fn open(path: &Path) -> Result<Self, ReplayError> {
        Self::open_with(path, None)
    }

    /// Opens a log to read only these topics: of a long one without a summary, such as that of a live run, it unpacks
    /// no more than it takes to know them. Damage then shows only where it is read.
    pub fn open_for(path: &Path, topics: &[&str]) -> Result<Self, ReplayError> {
        Self::open_with(path, Some(topics))
    }

    fn open_with(path: &Path, topics: Option<&[&str]>) -> Result<Self, ReplayError> {
        let mut log = Self::open_one(path, topics)?;
        for (part, number) in further_files(path, &log.info).into_iter().zip(1u32..) {
            let next = Self::open_one(&part, topics)?.info;
            if !continues(&log.info, &next, number) {
                break;
            }
            (log.info.complete, log.info.live) = (next.complete, next.live);
            log.info.topics.extend(next.topics);
            // One without messages has nothing to read.
            let times = next.span.or(log.info.span.map(|(_, end)| (end, end))).unwrap_or_default();
            if let (Some(span), Some((_, end))) = (&mut log.info.span, next.span) {
                span.1 = span.1.max(end);
            }
            log.parts.push((part, times));
        }
        Ok(log)
    }

    fn open_one(path: &Path, topics: Option<&[&str]>) -> Result<Self, ReplayError> {
        let mut records = RecordReader::open(path)?;
        let (mut channels, mut index) = (Channels::default(), Vec::new());
        let mut info = match records.summary_start()? {
            Some(start) => summary(&mut records, start, &mut channels, &mut index)?,
            None => None,
        }
        .map_or_else(|| scan(&mut records, &mut channels, topics), Ok)?;
        info.live = records.is_live();
        info.topics = channels.topics();
        info.metadata = metadata(&mut records)?;
        records.rewind()?;
        Ok(Self {
            parts: Vec::new(),
            first: path.to_owned(),
            part: 0,
            topics: topics.map(|topics| topics.iter().map(|topic| (*topic).to_owned()).collect()),
            records,
            selection: Selection::default(),
            info,
            channels,
            index,
            ready: VecDeque::new(),
            failed: None,
            lost: 0,
        })
    }

    /// Returns information about the log.
    pub fn info(&self) -> &LogInfo {
        &self.info
    }

    /// Restarts with the messages of a selection.
    pub fn select(&mut self, selection: Selection) -> Result<(), ReplayError> {
        self.selection = selection;
        self.ready.clear();
        self.failed = None;
        self.lost = 0;
        let from = self.selection.from;
        // The first file that has anything of the part; those before it end earlier.
        let part = self.parts.iter().rposition(|(_, (start, _))| *start <= from).map_or(0, |at| at + 1);
        if part != self.part {
            self.turn_to(part)?;
        }
        // A late part of a long log begins at its first chunk. Everything else that is read comes before the chunks.
        let (from, later) = (self.selection.from, self.info.span.is_some_and(|(start, _)| self.selection.from > start));
        match self.index.iter().filter(|(end, _)| *end >= from).map(|(_, at)| *at).min().filter(|_| later) {
            Some(at) => self.records.go_to(at),
            None => self.records.rewind(),
        }
    }

    /// Returns the next message; `None` at the end of a closed log, and at the newest chunk of a live one. Returns
    /// `ReplayError::Cut` once, where a truncated or damaged log ends.
    pub fn next_entry(&mut self) -> Result<Option<Entry>, ReplayError> {
        loop {
            if let Some(entry) = self.ready.pop_front() {
                return Ok(Some(entry));
            }
            if let Some(e) = self.failed.take() {
                return Err(e);
            }
            let Some(record) = self.records.next_record()? else {
                let next = self.parts.get(self.part).filter(|(_, (start, _))| *start <= self.selection.to);
                if next.is_none() {
                    return Ok(None);
                }
                self.turn_to(self.part + 1)?;
                continue;
            };
            // Messages before the damage come first.
            self.failed = self.take(&record).err();
        }
    }

    /// Opens another file of the log.
    fn turn_to(&mut self, part: usize) -> Result<(), ReplayError> {
        let path = part.checked_sub(1).and_then(|at| self.parts.get(at)).map_or(&self.first, |(path, _)| path);
        let topics: Option<Vec<&str>> = self.topics.as_ref().map(|topics| topics.iter().map(String::as_str).collect());
        let one = Self::open_one(path, topics.as_deref())?;
        (self.records, self.channels, self.index, self.part) = (one.records, one.channels, one.index, part);
        Ok(())
    }

    /// Returns the number of samples lost by the recorder so far, whether or not `/dimos/tick` is selected.
    pub fn lost(&self) -> u64 {
        self.lost
    }

    fn take(&mut self, record: &RawRecord) -> Result<(), ReplayError> {
        match record.opcode {
            op::CHUNK => {
                let Self { channels, selection, ready, lost, .. } = self;
                let mut take = || {
                    let header = chunk_header(&record.body)?;
                    if header.message_end_time >= selection.from && header.message_start_time <= selection.to {
                        unpack_chunk(&record.body, |opcode, body| channels.take(opcode, body, selection, ready, lost))?;
                    }
                    Ok::<(), mcap::McapError>(())
                };
                take().map_err(|e| self.records.cut(record.at, e))?;
                self.ready.make_contiguous().sort_by_key(|entry| entry.log_time);
            }
            opcode => self.channels.take(opcode, &record.body, &self.selection, &mut self.ready, &mut self.lost),
        }
        Ok(())
    }
}

/// Returns the files that may continue a log.
fn further_files(path: &Path, info: &LogInfo) -> Vec<PathBuf> {
    if info.metadata.contains_key(PART) { Vec::new() } else { files::further_parts(path).collect() }
}

/// Returns whether a file continues a log: it is of the same run, and has this number.
fn continues(log: &LogInfo, next: &LogInfo, number: u32) -> bool {
    let same = |key| log.metadata.get(key) == next.metadata.get(key);
    next.metadata.get(PART) == Some(&number.to_string()) && same("wall_offset_ns") && same("run")
}

/// Returns the files of a log in order: of one in several files all of them, if this is the first.
pub fn parts(path: &Path) -> Result<Vec<PathBuf>, ReplayError> {
    if !files::part(path, 1).exists() {
        return Ok(vec![path.to_owned()]);
    }
    let log = LogReader::open(path)?;
    Ok(std::iter::once(log.first).chain(log.parts.into_iter().map(|(path, _)| path)).collect())
}

/// Returns an attachment by name; `None` if there is none before the first message.
pub fn attachment(path: &Path, name: &str) -> Result<Option<Vec<u8>>, ReplayError> {
    let mut records = RecordReader::open(path)?.with_attachments();
    loop {
        let record = match records.next_record() {
            Ok(Some(record)) if !matches!(record.opcode, op::CHUNK | op::MESSAGE) => record,
            Ok(_) | Err(ReplayError::Cut { .. }) => return Ok(None),
            Err(e) => return Err(e),
        };
        if let Ok(Record::Attachment { header, data, .. }) = parse_record(record.opcode, &record.body)
            && header.name == name
        {
            return Ok(Some(data.into_owned()));
        }
    }
}

/// Reads time span and channels from the summary of a closed log; `None` if it lacks them.
fn summary(
    records: &mut RecordReader,
    start: u64,
    channels: &mut Channels,
    index: &mut Vec<(u64, u64)>,
) -> Result<Option<LogInfo>, ReplayError> {
    records.go_to(start)?;
    let mut info = None;
    loop {
        match records.next_record() {
            Ok(Some(record)) => {
                channels.learn(record.opcode, &record.body);
                if record.opcode == op::CHUNK_INDEX
                    && let Ok(Record::ChunkIndex(chunk)) = parse_record(record.opcode, &record.body)
                {
                    index.push((chunk.message_end_time, chunk.chunk_start_offset));
                }
                if record.opcode == op::STATISTICS
                    && let Ok(Record::Statistics(s)) = parse_record(record.opcode, &record.body)
                {
                    let span = (s.message_count > 0).then_some((s.message_start_time, s.message_end_time));
                    info = Some(LogInfo { span, complete: true, ..LogInfo::default() });
                }
            }
            Ok(None) => return Ok(info),
            // An unreadable summary counts as absent.
            Err(ReplayError::Cut { .. }) => return Ok(None),
            Err(e) => return Err(e),
        }
    }
}

/// Reads time span and channels of a log without a summary, from the whole file; with `topics`, channels only until
/// these are known.
fn scan(records: &mut RecordReader, channels: &mut Channels, topics: Option<&[&str]>) -> Result<LogInfo, ReplayError> {
    let knows = |channels: &Channels| {
        topics.is_some_and(|topics| topics.iter().all(|topic| channels.topics().contains_key(*topic)))
    };
    let mut known = knows(channels);
    records.rewind()?;
    let mut info = LogInfo::default();
    let mut seen = |from: u64, to: u64| {
        let (start, end) = info.span.unwrap_or((from, to));
        info.span = Some((start.min(from), end.max(to)));
    };
    loop {
        match records.next_record() {
            Ok(Some(record)) if record.opcode == op::CHUNK => {
                // One without messages has no times.
                let mut any = known && chunk_header(&record.body).is_ok_and(|header| header.message_end_time > 0);
                let each = |opcode, body: &[u8]| {
                    any |= opcode == op::MESSAGE;
                    channels.learn(opcode, body);
                };
                if !known && unpack_chunk(&record.body, each).is_err() {
                    return Ok(info);
                }
                known = known || knows(channels);
                if let (true, Ok(header)) = (any, chunk_header(&record.body)) {
                    seen(header.message_start_time, header.message_end_time);
                }
            }
            Ok(Some(record)) => {
                channels.learn(record.opcode, &record.body);
                if let Some((header, _)) = message(record.opcode, &record.body) {
                    seen(header.log_time, header.log_time);
                }
            }
            Ok(None) => {
                info.complete = !records.is_live();
                return Ok(info);
            }
            Err(ReplayError::Cut { .. }) => return Ok(info),
            Err(e) => return Err(e),
        }
    }
}

/// Reads the run's metadata, stored before the first message.
fn metadata(records: &mut RecordReader) -> Result<BTreeMap<String, String>, ReplayError> {
    records.rewind()?;
    loop {
        let record = match records.next_record() {
            Ok(Some(record)) => record,
            Ok(None) | Err(ReplayError::Cut { .. }) => return Ok(BTreeMap::new()),
            Err(e) => return Err(e),
        };
        match parse_metadata(&record) {
            Some(found) => return Ok(found),
            None if matches!(record.opcode, op::CHUNK | op::MESSAGE) => return Ok(BTreeMap::new()),
            None => {}
        }
    }
}

fn parse_metadata(record: &RawRecord) -> Option<BTreeMap<String, String>> {
    if record.opcode != op::METADATA {
        return None;
    }
    match parse_record(record.opcode, &record.body) {
        Ok(Record::Metadata(m)) if m.name == "dimos" => Some(m.metadata),
        _ => None,
    }
}
