//! Reads a log: its decoded messages in order of time.

use std::cmp::{Ordering, Reverse};
use std::collections::{BTreeMap, BinaryHeap, HashSet, VecDeque};
use std::path::{Path, PathBuf};

use mcap::parse_record;
use mcap::records::{Record, op};

use super::attachment::{self, DAMAGED};
use super::entries::Channels;
use super::loss::Loss;
use super::records::{Damage, Kept, RawRecord, RecordReader};
use super::source::{Block, Source};
use super::source_files;

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

/// A message that waits for its time.
struct Ready {
    /// Order of messages: their time, then the file and position of their block, and their number in it.
    key: (u64, (usize, u64, u32)),
    entry: Entry,
}

impl Ord for Ready {
    fn cmp(&self, other: &Self) -> Ordering {
        self.key.cmp(&other.key)
    }
}

impl PartialOrd for Ready {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Ready {
    fn eq(&self, other: &Self) -> bool {
        self.key == other.key
    }
}

impl Eq for Ready {}

/// A log opened for reading: of one in several files all of them, if it is opened by the first or their folder.
pub struct LogReader {
    source: Source,
    selection: Selection,
    info: LogInfo,
    channels: Channels,
    /// Blocks to read.
    queue: VecDeque<usize>,
    /// Messages that were read, the first one on top.
    ready: BinaryHeap<Reverse<Ready>>,
    /// Damage to report after what is ready.
    failed: VecDeque<ReplayError>,
    found: Loss,
    /// Messages that the summaries count.
    counted: u64,
    ended: bool,
    /// Whether all channels were looked for when it was opened: others belong to no message.
    knows_all: bool,
}

impl LogReader {
    /// Opens a log. Of one whose summary does not describe all channels it reads everything once.
    pub fn open(path: &Path) -> Result<Self, ReplayError> {
        Self::open_with(path, None)
    }

    /// Opens a log to read only these topics: of a long one without a summary, such as that of a live run, it unpacks
    /// no more than it takes to know them. Damage then shows only where it is read.
    pub fn open_for(path: &Path, topics: &[&str]) -> Result<Self, ReplayError> {
        Self::open_with(path, Some(topics))
    }

    fn open_with(path: &Path, topics: Option<&[&str]>) -> Result<Self, ReplayError> {
        let mut source = Source::open(path)?;
        let mut channels = Channels::default();
        let mut counted = 0;
        for (file, opcode, body) in std::mem::take(&mut source.outside) {
            channels.learn(file, opcode, &body);
            if let Ok(Record::Statistics(statistics)) = parse_record(opcode, &body) {
                counted += statistics.message_count;
            }
        }
        let enough = |channels: &Channels| {
            topics.is_some_and(|topics| topics.iter().all(|topic| channels.topics().contains_key(*topic)))
        };
        if !enough(&channels) {
            let described = |block: &Block, channels: &Channels| {
                block.channels.as_deref().is_some_and(|ids| channels.know(block.file, ids))
            };
            let known: HashSet<(usize, u64)> = source
                .blocks
                .iter()
                .filter(|block| described(block, &channels))
                .map(|block| (block.file, block.at))
                .collect();
            source.learn(
                |file, opcode, body| {
                    channels.learn(file, opcode, body);
                    opcode == op::CHANNEL && enough(&channels)
                },
                |block| known.contains(&(block.file, block.at)),
            )?;
        }
        let mut info = LogInfo {
            span: source.span(),
            complete: source.is_complete(),
            live: source.is_live(),
            topics: channels.topics(),
            metadata: BTreeMap::new(),
        };
        for other in source.others.clone().into_iter().filter(|(_, _, opcode)| *opcode == op::METADATA) {
            let Some(record) = source.other(other)? else { continue };
            if let Ok(Record::Metadata(found)) = parse_record(record.opcode, &record.body)
                && found.name == "dimos"
            {
                info.metadata = found.metadata;
                break;
            }
        }
        let mut log = Self {
            source,
            selection: Selection::default(),
            info,
            channels,
            queue: VecDeque::new(),
            ready: BinaryHeap::new(),
            failed: VecDeque::new(),
            found: Loss::default(),
            counted,
            ended: false,
            knows_all: topics.is_none(),
        };
        log.select(Selection::default())?;
        Ok(log)
    }

    /// Returns information about the log.
    pub fn info(&self) -> &LogInfo {
        &self.info
    }

    /// Restarts with the messages of a selection.
    pub fn select(&mut self, selection: Selection) -> Result<(), ReplayError> {
        self.ready.clear();
        self.ended = false;
        self.found = Loss { began: self.info.span.map_or(0, |(start, _)| start), ..Loss::default() };
        (self.channels.lost, self.channels.unknown, self.channels.count) = (0, 0, 0);
        let inside = |start: u64, end: u64| end >= selection.from && start <= selection.to;
        let blocks = self.source.blocks.iter().enumerate();
        self.queue = blocks.filter(|(_, block)| inside(block.start, block.end)).map(|(index, _)| index).collect();
        let damage = self.source.damage.iter();
        let damage = damage.filter(|damage| damage.span.is_none_or(|(start, end)| inside(start, end)));
        self.failed = damage.map(|damage| ReplayError::Damaged { damage: damage.clone() }).collect();
        self.selection = selection;
        Ok(())
    }

    /// Returns the next message; `None` at the end of a closed log, and at the newest chunk of a live one. Returns
    /// `ReplayError::Damaged` once for each part that is damaged, and continues after it; `ReplayError::Cut` once,
    /// where a truncated log ends.
    pub fn next_entry(&mut self) -> Result<Option<Entry>, ReplayError> {
        loop {
            // Later blocks may have messages as old as that.
            let later = self.queue.front().and_then(|next| self.source.blocks.get(*next));
            let until = later.map_or(u64::MAX, |block| block.start);
            let is_due = self.ready.peek().is_some_and(|Reverse(first)| first.key.0 <= until);
            if let Some(Reverse(Ready { entry, .. })) = is_due.then(|| self.ready.pop()).flatten() {
                if matches!(entry.data, Payload::Damaged { .. } | Payload::Unknown { .. }) {
                    self.found.undecoded += 1;
                }
                return Ok(Some(entry));
            }
            if let Some(damaged) = self.failed.pop_front() {
                if let ReplayError::Damaged { damage } = &damaged {
                    self.found.damage.push(damage.clone());
                }
                return Err(damaged);
            }
            let Some(next) = self.queue.pop_front() else {
                let cut = self.source.cut.as_ref().filter(|_| !std::mem::replace(&mut self.ended, true));
                let Some((path, at, reason)) = cut else { return Ok(None) };
                self.found.cut = Some(format!("it ends at byte {at}: {reason}"));
                return Err(ReplayError::Cut { path: path.to_path_buf(), at: *at, reason: reason.clone() });
            };
            let Self { source, channels, selection, ready, .. } = self;
            let Some(place) = source.blocks.get(next).map(|block| (block.file, block.at)) else { continue };
            let mut number = 0;
            let damage = source.read(next, |file, opcode, body| {
                if let Some(entry) = channels.take(file, opcode, body, selection) {
                    number += 1;
                    ready.push(Reverse(Ready { key: (entry.log_time, (place.0, place.1, number)), entry }));
                }
            })?;
            self.failed.extend(damage.map(|damage| ReplayError::Damaged { damage }));
        }
    }

    /// Returns what was found missing in the selection so far; a cut counts only if the selection reaches to it.
    pub fn loss(&self) -> Loss {
        let mut loss = self.found.clone();
        loss.unknown = if self.knows_all { self.channels.unknown } else { 0 };
        let (start, end) = self.info.span.unwrap_or_default();
        if self.selection.to < end {
            loss.cut = None;
        }
        // All blocks were read, whatever topics are wanted.
        let is_whole = self.selection.from <= start && self.selection.to >= end && self.queue.is_empty();
        if is_whole && self.info.complete && self.counted > self.channels.count {
            loss.missing = (self.counted - self.channels.count, self.counted);
        }
        loss
    }

    /// Returns the number of samples lost by the recorder so far, whether or not `/dimos/tick` is selected.
    pub fn lost(&self) -> u64 {
        self.channels.lost
    }
}

/// Returns the files of a log that can be read, in order: of one in several files all of them, if this is the first or
/// their folder.
pub fn parts(path: &Path) -> Result<Vec<PathBuf>, ReplayError> {
    Ok(source_files::of(path)?.into_iter().filter(|file| file.wrong.is_none()).map(|file| file.path).collect())
}

/// Returns an attachment by name; `None` if there is none. An error if it is damaged, also if that was before this log
/// was copied.
pub fn attachment(path: &Path, name: &str) -> Result<Option<Vec<u8>>, ReplayError> {
    let named = |record: &RawRecord, path: &Path| {
        let is_one = record.opcode == op::ATTACHMENT;
        let found = attachment::of(&record.body).filter(|found| is_one && found.header.name == name)?;
        let before = || attachment::metadata(&mut RecordReader::open(path).ok()?, DAMAGED)?.remove(name);
        Some(found.damage.or_else(before).map_or(Ok(Some(found.data)), |reason| {
            let (path, reason) = (path.to_owned(), format!("{name}: {reason}"));
            Err(ReplayError::Damaged { damage: Damage { path, at: record.at, span: None, reason, kept: Kept::None } })
        }))
    };
    // Most are before the first message: a long log is not read for them.
    if let Some(part) = parts(path)?.first() {
        let mut records = RecordReader::open(part)?.with_attachments();
        while let Ok(Some(record)) = records.next_record() {
            if let Some(found) = named(&record, part) {
                return found;
            }
            if matches!(record.opcode, op::CHUNK | op::MESSAGE) {
                break;
            }
        }
    }
    let mut source = Source::open(path)?;
    for other in source.others.clone() {
        let Some(record) = source.other(other)? else { continue };
        if let Some(found) = named(&record, source.path(other.0)) {
            return found;
        }
    }
    Ok(None)
}
