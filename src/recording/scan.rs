//! Reads all messages of a log as bytes in order of time, with their schemas: for tools that check, print, cut or
//! repair logs of any origin. What is damaged is reported.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::path::Path;

use mcap::parse_record;
use mcap::records::{Record, Statistics, op};

use super::cdr::CdrError;
use super::loss::Loss;
use super::records::{RawRecord, ReplayError};
use super::ros2msg::Schema;
use super::source::{Block, Source};

/// A channel of a log.
#[derive(Debug, Clone, Default)]
pub struct LogChannel {
    /// Topic.
    pub topic: String,
    /// Encoding of messages: `cdr`.
    pub encoding: String,
    /// Further properties, such as the offered QoS.
    pub metadata: BTreeMap<String, String>,
    /// Name, encoding and text of the schema.
    pub schema: (String, String, Vec<u8>),
    /// The schema, to decode messages; an error if they cannot be decoded.
    pub decoder: Option<Schema>,
}

/// A message of the current batch.
#[derive(Debug, Clone, Copy)]
pub struct RawMessage {
    /// Unix time [ns].
    pub time: u64,
    /// Channel.
    pub channel: u16,
    /// Number on its channel.
    pub sequence: u32,
    /// Unix time at which it was published [ns].
    pub published: u64,
    /// Where it was written: file and position of its chunk. What was written later is greater.
    pub place: (usize, u64),
    /// Where its bytes are in the batch.
    pub(super) span: (usize, usize),
}

/// What was read.
pub enum Item {
    /// A batch of messages, none older than those before: see [`Scan::messages`].
    Messages,
    /// An attachment or metadata; they come before all messages.
    Other(RawRecord),
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
    /// Messages that were read.
    count: u64,
    /// Bytes of the messages, of which the first `given` are the current batch.
    bytes: Vec<u8>,
    messages: Vec<RawMessage>,
    given: usize,
    /// Blocks to read.
    pub(super) queue: VecDeque<usize>,
    others: VecDeque<(usize, u64, u8)>,
    /// Bytes of the blocks that were read.
    passed: u64,
}

/// What describes channels, by file and its own ids.
#[derive(Default)]
struct Described {
    schemas: HashMap<(usize, u16), (String, String, Vec<u8>)>,
    /// Ids in [`Scan::channels`].
    ids: HashMap<(usize, u16), u16>,
    profile: Option<String>,
    statistics: Vec<Statistics>,
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
            bytes: Vec::new(),
            messages: Vec::new(),
            given: 0,
            queue: VecDeque::new(),
            others: VecDeque::new(),
            passed: 0,
        };
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
        Some((all.iter().map(|s| s.message_count).sum(), all.first()?))
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
        let is_whole = self.topics.is_empty() && (from, to) == (0, u64::MAX) && self.queue.is_empty();
        let counted = self.statistics().filter(|_| is_whole && self.is_complete()).map_or(0, |(count, _)| count);
        if counted > self.count {
            loss.missing = (counted - self.count, counted);
        }
        loss
    }

    /// Restarts with another part, without attachments and metadata; what was found before is kept.
    pub(super) fn restart(&mut self, part: (u64, u64)) {
        (self.part, self.given, self.found.unknown) = (part, self.messages.len(), 0);
        self.others.clear();
        self.forget_given();
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
                return Ok(Some(Item::Other(record)));
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
            self.given = self.messages.partition_point(|message| message.time <= until);
            match (self.given, next) {
                (0, None) => return Ok(None),
                (0, Some(_)) => {}
                _ => return Ok(Some(Item::Messages)),
            }
        }
    }

    /// Removes the batch that was given out.
    pub(super) fn forget_given(&mut self) {
        if self.given == self.messages.len() {
            self.messages.clear();
            self.bytes.clear();
        } else if self.given > 0 {
            self.messages.drain(..self.given);
            let mut bytes = Vec::new();
            for message in &mut self.messages {
                let start = bytes.len();
                bytes.extend_from_slice(self.bytes.get(message.span.0..message.span.1).unwrap_or_default());
                message.span = (start, bytes.len());
            }
            self.bytes = bytes;
        }
        self.given = 0;
    }

    fn read(&mut self, index: usize) -> Result<(), ReplayError> {
        let Self { source, channels, described, bytes, messages, found, count, .. } = self;
        let Some(block) = source.blocks.get(index) else { return Ok(()) };
        let place = (block.file, block.at);
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
            *count += 1;
            let start = bytes.len();
            bytes.extend_from_slice(&data);
            messages.push(RawMessage {
                time: header.log_time,
                channel: *channel,
                sequence: header.sequence,
                published: header.publish_time,
                place,
                span: (start, bytes.len()),
            });
        })?;
        found.damage.extend(damage.filter(|damage| !found.damage.contains(damage)));
        messages.sort_by_key(|message| (message.time, message.place));
        Ok(())
    }

    /// Returns the messages of the batch, in order of time.
    pub fn messages(&self) -> impl Iterator<Item = (&RawMessage, &LogChannel, &[u8])> {
        self.messages.iter().take(self.given).filter_map(|message| {
            let bytes = self.bytes.get(message.span.0..message.span.1)?;
            Some((message, self.channels.get(&message.channel)?, bytes))
        })
    }
}

impl Described {
    /// Takes a record that describes messages. Equal channels of several files become one.
    fn learn(&mut self, channels: &mut BTreeMap<u16, LogChannel>, file: usize, opcode: u8, body: &[u8]) {
        match parse_record(opcode, body) {
            Ok(Record::Header(header)) => {
                self.profile.get_or_insert(header.profile);
            }
            Ok(Record::Schema { header, data }) => {
                self.schemas.insert((file, header.id), (header.name, header.encoding, data.into_owned()));
            }
            Ok(Record::Channel(channel)) => {
                let schema = self.schemas.get(&(file, channel.schema_id)).cloned().unwrap_or_default();
                let id = channel.id;
                let is_it = |known: &LogChannel| {
                    (&known.topic, &known.encoding, &known.metadata, &known.schema)
                        == (&channel.topic, &channel.message_encoding, &channel.metadata, &schema)
                };
                // Its own id if that is free: copies of a log have the same ids.
                let same = channels.get(&id).is_some_and(is_it).then_some(id);
                let same =
                    same.or_else(|| channels.iter().find(|(_, known)| file > 0 && is_it(known)).map(|(id, _)| *id));
                let free = || std::iter::once(id).chain(1..=u16::MAX).find(|id| !channels.contains_key(id));
                let Some(own) = same.or_else(free) else { return };
                self.ids.insert((file, id), own);
                if same.is_some() {
                    return;
                }
                let readable = schema.1 == "ros2msg" && channel.message_encoding == "cdr";
                let text = std::str::from_utf8(&schema.2).ok().filter(|_| readable);
                let decoder = text.and_then(|text| Schema::parse(&schema.0, text).ok());
                let (topic, encoding, metadata) = (channel.topic, channel.message_encoding, channel.metadata);
                channels.insert(own, LogChannel { topic, encoding, metadata, schema, decoder });
            }
            Ok(Record::Statistics(statistics)) => self.statistics.push(statistics),
            _ => {}
        }
    }
}

impl LogChannel {
    /// Appends a message as JSON. An error if its schema is not understood, or if it does not match.
    pub fn json(&self, bytes: &[u8], out: &mut String) -> Result<(), CdrError> {
        self.decoder.as_ref().ok_or(CdrError::Header)?.json(bytes, out)
    }
}
