//! Reads all messages of a log as bytes in order of time, with their schemas: for tools that check, print, cut or
//! repair logs of any origin. What is damaged is reported.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap, HashMap, VecDeque};
use std::path::Path;

use mcap::parse_record;
use mcap::records::{Record, Statistics, op};

use super::channels::Described;
use super::loss::Loss;
use super::records::{RawRecord, ReplayError};
use super::source::{Block, Source};

pub use super::channels::LogChannel;

/// A message of the current batch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RawMessage {
    /// Unix time [ns].
    pub time: u64,
    /// Channel.
    pub channel: u16,
    /// Number on its channel.
    pub sequence: u32,
    /// Unix time at which it was published [ns].
    pub published: u64,
    /// Where it was written: file, position of its chunk, number in it. What was written later is greater.
    pub place: (usize, u64, u32),
    /// The block that has its bytes, and where they are in it.
    pub(super) block: usize,
    pub(super) span: (usize, usize),
}

impl Ord for RawMessage {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        (self.time, self.place).cmp(&(other.time, other.place))
    }
}

impl PartialOrd for RawMessage {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

/// The bytes of messages of a block, and how many of these were not given out yet.
#[derive(Default)]
struct Held {
    bytes: Vec<u8>,
    left: usize,
}

/// What was read.
pub enum Item {
    /// A batch of messages, none older than those before: see [`Scan::messages`].
    Messages,
    /// An attachment or metadata, with the index of its file; they come before all messages.
    Other(usize, RawRecord),
}

/// A log that is read from its beginning to its end.
pub struct Scan {
    pub(super) source: Source,
    /// Channels, of all files.
    pub channels: BTreeMap<u16, LogChannel>,
    described: Described,
    /// First and last Unix time to read [ns]. Messages outside may be read too.
    part: (u64, u64),
    /// Topics that are read; empty: all.
    topics: Vec<String>,
    /// What was found damaged so far.
    found: Loss,
    /// Messages on the wanted topics that were read.
    count: u64,
    /// Whether these are to be all of them: a window is no measure of what is missing.
    counts: bool,
    /// The current batch.
    batch: Vec<RawMessage>,
    /// Messages that were read and are too late for it.
    waiting: BinaryHeap<Reverse<RawMessage>>,
    /// What both need, by block.
    held: HashMap<usize, Held>,
    /// Blocks to read.
    pub(super) queue: VecDeque<usize>,
    others: VecDeque<(usize, u64, u8)>,
    /// Bytes of the blocks that were read.
    passed: u64,
}

impl Scan {
    /// Opens a log: of one in several files all of them, if this is the first or their folder.
    pub fn open(path: &Path) -> Result<Self, ReplayError> {
        Self::open_part(path, &[], (0, u64::MAX))
    }

    /// Opens a log to read some topics, all if there are none, between two Unix times [ns]. Other messages may be read
    /// too: also earlier ones, if it is read for a copy with [`Self::with_earlier`].
    pub fn open_part(path: &Path, topics: &[String], part: (u64, u64)) -> Result<Self, ReplayError> {
        let mut scan = Self {
            source: Source::open(path)?,
            channels: BTreeMap::new(),
            described: Described::default(),
            part,
            topics: topics.to_vec(),
            found: Loss::default(),
            count: 0,
            counts: false,
            batch: Vec::new(),
            waiting: BinaryHeap::new(),
            held: HashMap::new(),
            queue: VecDeque::new(),
            others: VecDeque::new(),
            passed: 0,
        };
        scan.counts = scan.source.span().is_none_or(|(start, end)| part.0 <= start && part.1 >= end);
        scan.describe()?;
        scan.others = scan.source.others.iter().copied().collect();
        scan.choose(part.0);
        Ok(scan)
    }

    /// Also reads what is before the part.
    pub fn with_earlier(mut self) -> Self {
        self.choose(0);
        self
    }

    /// Learns the channels that are described outside of chunks; all others too if messages are out of order, or if an
    /// index has channels that are not described there.
    pub(super) fn describe(&mut self) -> Result<(), ReplayError> {
        for (file, opcode, body) in std::mem::take(&mut self.source.outside) {
            self.described.learn(&mut self.channels, file, opcode, &body);
        }
        let described = |block: &Block| {
            block.channels.iter().flatten().all(|id| self.described.ids.contains_key(&(block.file, *id)))
        };
        if !self.source.is_in_order() || !self.source.blocks.iter().all(described) {
            self.learn_all()?;
        }
        Ok(())
    }

    /// Learns all channels, and those of each block.
    pub(super) fn learn_all(&mut self) -> Result<(), ReplayError> {
        let Self { source, channels, described, .. } = self;
        let ids: HashMap<(usize, u16), u16> = described.ids.clone();
        let known = |block: &Block| {
            let all = |list: &[u16]| list.iter().all(|id| ids.contains_key(&(block.file, *id)));
            block.channels.as_deref().is_some_and(all)
        };
        source.learn(
            |file, opcode, body| {
                described.learn(channels, file, opcode, body);
                false
            },
            known,
        )
    }

    /// Chooses the blocks of the part, from a time on. Those of which an index shows that they have no message of the
    /// topics are left out.
    fn choose(&mut self, from: u64) {
        let to = self.part.1;
        let wanted = |block: &Block| {
            let Some(channels) = block.channels.as_deref().filter(|_| !self.topics.is_empty()) else { return true };
            channels.iter().any(|id| {
                let channel = self.channel_of(block.file, *id);
                channel.is_none_or(|(_, channel)| self.topics.contains(&channel.topic))
            })
        };
        let blocks = self.source.blocks.iter().enumerate();
        let chosen = blocks.filter(|(_, block)| {
            // What no index describes may describe channels.
            let inside = block.end >= from || block.channels.is_none() || !block.has_times();
            inside && block.start <= to && wanted(block)
        });
        self.queue = chosen.map(|(index, _)| index).collect();
    }

    /// Returns the channel that a file calls `id`, and its id in [`Self::channels`].
    pub(super) fn channel_of(&self, file: usize, id: u16) -> Option<(u16, &LogChannel)> {
        let id = self.described.ids.get(&(file, id))?;
        Some((*id, self.channels.get(id)?))
    }

    /// Returns the part [ns].
    pub fn part(&self) -> (u64, u64) {
        self.part
    }

    /// Returns the profile of the log: `ros2`.
    pub fn profile(&self) -> &str {
        self.described.profile.as_deref().unwrap_or_default()
    }

    /// Returns the number of messages that the summaries count, and those of each channel of the first file.
    pub fn statistics(&self) -> Option<(u64, &Statistics)> {
        let all = &self.described.statistics;
        Some((all.iter().map(|(_, s)| s.message_count).sum(), &all.first()?.1))
    }

    /// Returns the number of messages on the wanted topics that the summaries count.
    fn counted(&self) -> u64 {
        let wanted = |file: usize, id: u16| {
            let topic = self.channel_of(file, id).map(|(_, channel)| &channel.topic);
            topic.is_some_and(|topic| self.topics.contains(topic))
        };
        let of_file = |(file, statistics): &(usize, Statistics)| match self.topics.is_empty() {
            true => statistics.message_count,
            false => {
                let counts = statistics.channel_message_counts.iter();
                counts.filter(|(id, _)| wanted(*file, **id)).map(|(_, count)| count).sum()
            }
        };
        self.described.statistics.iter().map(of_file).sum()
    }

    /// Returns whether it was closed properly.
    pub fn is_complete(&self) -> bool {
        self.source.is_complete()
    }

    /// Returns whether a live run was writing the log when it was opened.
    pub fn is_live(&self) -> bool {
        self.source.is_live()
    }

    /// Returns how much was read, of how much [bytes].
    pub fn position(&self) -> (u64, u64) {
        (self.passed, self.source.length())
    }

    /// Adds an attachment or metadata to what the log lacks.
    pub fn lacks(&mut self, what: String) {
        self.found.others.push(what);
    }

    /// Counts a message that cannot be decoded.
    pub fn not_decoded(&mut self, count: u64) {
        self.found.undecoded += count;
    }

    /// Returns what was found missing in the part so far; at the end, all that is.
    pub fn loss(&self) -> Loss {
        self.loss_of(self.part)
    }

    /// Returns what was found missing in another part so far.
    pub(super) fn loss_of(&self, (from, to): (u64, u64)) -> Loss {
        let mut loss = self.found.clone();
        let span = self.source.span();
        loss.began = span.map_or(0, |(start, _)| start);
        let inside = |span: Option<(u64, u64)>| span.is_none_or(|(start, end)| end >= from && start <= to);
        loss.damage.extend(self.source.damage.iter().filter(|damage| inside(damage.span)).cloned());
        loss.damage.sort_by(|a, b| (&a.path, a.at).cmp(&(&b.path, b.at)));
        // A part that ends before a cut lacks nothing.
        let reaches_end = span.is_none_or(|(_, end)| to >= end);
        if let Some((_, at, reason)) = self.source.cut.as_ref().filter(|_| reaches_end) {
            loss.cut = Some(format!("it ends at byte {at}: {reason}"));
        } else if !self.is_complete() && !self.is_live() && reaches_end {
            loss.cut = Some("it was not closed".to_owned());
        }
        let is_whole = self.counts && self.queue.is_empty() && self.is_complete();
        let counted = if is_whole { self.counted() } else { 0 };
        if counted > self.count {
            loss.missing = (counted - self.count, counted);
        }
        loss
    }

    /// Restarts with another part, without attachments and metadata; what was found before is kept.
    pub(super) fn restart(&mut self, part: (u64, u64)) {
        (self.part, self.counts, self.found.unknown) = (part, false, 0);
        self.others.clear();
        self.batch.clear();
        self.waiting.clear();
        self.held.clear();
        self.choose(part.0);
    }

    /// Leaves out the next blocks that are not wanted.
    pub(super) fn skip(&mut self, unwanted: impl Fn(&Self, &Block) -> bool) {
        while let Some(block) = self.queue.front().and_then(|next| self.source.blocks.get(*next))
            && unwanted(self, block)
        {
            self.queue.pop_front();
        }
    }

    /// Reads on; `None` at the end, or at the cut.
    pub fn next_item(&mut self) -> Result<Option<Item>, ReplayError> {
        self.forget_given();
        while let Some(other) = self.others.pop_front() {
            if let Some(record) = self.source.other(other)? {
                return Ok(Some(Item::Other(other.0, record)));
            }
        }
        loop {
            let next = self.queue.pop_front();
            if let Some(block) = next {
                self.read(block)?;
            }
            // Later blocks may have messages as old as that.
            let later = self.queue.front().and_then(|next| self.source.blocks.get(*next));
            let until = later.map_or(u64::MAX, |block| block.start);
            while self.waiting.peek().is_some_and(|Reverse(first)| first.time <= until) {
                self.batch.extend(self.waiting.pop().map(|Reverse(first)| first));
            }
            match (self.batch.is_empty(), next) {
                (true, None) => return Ok(None),
                (true, Some(_)) => {}
                _ => return Ok(Some(Item::Messages)),
            }
        }
    }

    /// Removes the batch that was given out, and the blocks that only it needed.
    fn forget_given(&mut self) {
        for message in self.batch.drain(..) {
            let Some(held) = self.held.get_mut(&message.block) else { continue };
            held.left -= 1;
            if held.left == 0 {
                self.held.remove(&message.block);
            }
        }
    }

    fn read(&mut self, index: usize) -> Result<(), ReplayError> {
        let Self { source, channels, described, topics, waiting, found, count, .. } = self;
        let Some(block) = source.blocks.get(index) else { return Ok(()) };
        let (at, mut held) = (block.at, Held::default());
        self.passed += block.length();
        let damage = source.read(index, |file, opcode, body| {
            if opcode != op::MESSAGE {
                return described.learn(channels, file, opcode, body);
            }
            let Ok(Record::Message { header, data }) = parse_record(opcode, body) else { return };
            let Some(channel) = described.ids.get(&(file, header.channel_id)) else {
                found.unknown += 1;
                return;
            };
            let is_wanted = |channel: &LogChannel| topics.is_empty() || topics.contains(&channel.topic);
            *count += u64::from(channels.get(channel).is_some_and(is_wanted));
            let start = held.bytes.len();
            held.bytes.extend_from_slice(&data);
            waiting.push(Reverse(RawMessage {
                time: header.log_time,
                channel: *channel,
                sequence: header.sequence,
                published: header.publish_time,
                place: (file, at, held.left as u32),
                block: index,
                span: (start, held.bytes.len()),
            }));
            held.left += 1;
        })?;
        if held.left > 0 {
            self.held.insert(index, held);
        }
        found.damage.extend(damage.filter(|damage| !found.damage.contains(damage)));
        Ok(())
    }

    /// Returns the messages of the batch, in order of time.
    pub fn messages(&self) -> impl Iterator<Item = (&RawMessage, &LogChannel, &[u8])> {
        self.batch.iter().filter_map(|message| {
            let bytes = self.held.get(&message.block)?.bytes.get(message.span.0..message.span.1)?;
            Some((message, self.channels.get(&message.channel)?, bytes))
        })
    }
}
