//! Reads all messages of a log as bytes, with their schemas: for tools that check, print, cut or repair logs of any
//! origin. Chunks that are damaged are skipped and reported.

use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};

use mcap::parse_record;
use mcap::records::{Record, Statistics, op};

use super::cdr::CdrError;
use super::records::{RawRecord, RecordReader, ReplayError, chunk_header, unpack_chunk};
use super::replay::parts;
use super::ros2msg::Schema;

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
    /// Where its bytes are in the batch.
    pub(super) span: (usize, usize),
}

/// What was read.
pub enum Item {
    /// A batch of messages: see [`Scan::messages`].
    Messages,
    /// An attachment or metadata.
    Other(RawRecord),
}

/// A log that is read from its beginning to its end.
pub struct Scan {
    pub(super) records: RecordReader,
    /// Channels read so far.
    pub channels: BTreeMap<u16, LogChannel>,
    schemas: BTreeMap<u16, (String, String, Vec<u8>)>,
    /// Profile of the log: `ros2`.
    pub profile: String,
    /// First and last Unix time to read [ns]. Messages outside may be read too.
    pub part: (u64, u64),
    /// What is damaged: position [bytes] and reason.
    pub damage: Vec<(u64, String)>,
    /// Why the log ends early.
    pub cut: Option<String>,
    /// Whether it was closed properly.
    pub complete: bool,
    /// Newest Unix time of a message seen so far, read or not [ns].
    latest: u64,
    /// Statistics at its end.
    pub statistics: Option<Statistics>,
    bytes: Vec<u8>,
    messages: Vec<RawMessage>,
    /// Chunks to read; `None`: everything.
    pub(super) chunks: Option<VecDeque<u64>>,
    /// Topics of which only these chunks are read.
    topics: Option<Vec<String>>,
    /// Further files of the log, and whether the current one is of these.
    rest: VecDeque<PathBuf>,
    further: bool,
    /// Messages that the summaries of earlier files count.
    counted: u64,
}

impl Scan {
    /// Opens a log: of one in several files all of them, if this is the first.
    pub fn open(path: &Path) -> Result<Self, ReplayError> {
        Ok(Self {
            records: RecordReader::open(path)?.with_attachments(),
            channels: BTreeMap::new(),
            schemas: BTreeMap::new(),
            profile: String::new(),
            part: (0, u64::MAX),
            damage: Vec::new(),
            cut: None,
            complete: false,
            latest: 0,
            statistics: None,
            bytes: Vec::new(),
            messages: Vec::new(),
            chunks: None,
            topics: None,
            rest: parts(path)?.into_iter().skip(1).collect(),
            further: false,
            counted: 0,
        })
    }

    /// Opens a log to read some topics, all if there are none, between two Unix times [ns]: of a closed log only the
    /// chunks that have them. Other messages may be read too.
    pub fn open_part(path: &Path, topics: &[String], part: (u64, u64)) -> Result<Self, ReplayError> {
        let mut scan = Self::open(path)?;
        (scan.part, scan.topics) = (part, Some(topics.to_vec()));
        scan.choose_chunks()?;
        Ok(scan)
    }

    fn choose_chunks(&mut self) -> Result<(), ReplayError> {
        let part = self.part;
        let scan = self;
        scan.chunks = None;
        let Some(topics) = scan.topics.clone() else { return Ok(()) };
        let Some(start) = scan.records.summary_start()? else { return scan.records.rewind() };
        scan.records.go_to(start)?;
        let mut chunks = Vec::new();
        while let Ok(Some(record)) = scan.records.next_record() {
            scan.learn(record.opcode, &record.body);
            if let Ok(Record::ChunkIndex(index)) = parse_record(record.opcode, &record.body) {
                chunks.push(index);
            }
        }
        let wanted = |channel: &u16| scan.channels.get(channel).is_some_and(|c| topics.contains(&c.topic));
        chunks.retain(|index| {
            let any = topics.is_empty() || index.message_index_offsets.keys().any(wanted);
            any && index.message_end_time >= part.0 && index.message_start_time <= part.1
        });
        // A file without chunks, or without indexes, is read in full.
        let indexed = scan.statistics.as_ref().is_some_and(|s| s.chunk_count > 0) && scan.complete;
        if indexed && chunks.iter().all(|index| !index.message_index_offsets.is_empty()) {
            scan.chunks = Some(chunks.iter().map(|index| index.chunk_start_offset).collect());
        }
        scan.complete = false;
        scan.records.rewind()
    }

    /// Continues with the next file of the log, if there is one.
    fn turn_over(&mut self) -> Result<bool, ReplayError> {
        let Some(next) = self.rest.pop_front().filter(|_| self.complete) else { return Ok(false) };
        self.records = RecordReader::open(&next)?.with_attachments();
        (self.complete, self.further) = (false, true);
        self.counted += self.statistics.take().map_or(0, |s| s.message_count);
        self.choose_chunks()?;
        Ok(true)
    }

    /// Returns the number of messages that the summaries count.
    pub fn counted(&self) -> Option<u64> {
        self.statistics.as_ref().map(|s| s.message_count + self.counted)
    }

    /// Returns whether a live run was writing the log when it was opened.
    pub fn is_live(&self) -> bool {
        self.records.is_live()
    }

    /// Returns whether the part reaches to the end of what can be read: only then it lacks what a cut has taken.
    pub fn part_reaches_end(&self) -> bool {
        self.part.1 >= self.latest
    }

    /// Returns the position, and the length of the file [bytes].
    pub fn position(&self) -> (u64, u64) {
        self.records.position()
    }

    /// Reads on; `None` at the end, or at the cut.
    pub fn next_item(&mut self) -> Result<Option<Item>, ReplayError> {
        loop {
            if let Some(chunks) = &mut self.chunks {
                match chunks.pop_front() {
                    Some(at) => self.records.go_to(at)?,
                    None => {
                        self.complete = true;
                        if self.turn_over()? {
                            continue;
                        }
                        return Ok(None);
                    }
                }
            }
            let record = match self.records.next_record() {
                Ok(Some(record)) => record,
                Ok(None) if self.turn_over()? => continue,
                Ok(None) => return Ok(None),
                Err(ReplayError::Cut { at, reason, .. }) => {
                    self.cut = Some(format!("it ends at byte {at}: {reason}"));
                    return Ok(None);
                }
                Err(e) => return Err(e),
            };
            self.bytes.clear();
            self.messages.clear();
            match record.opcode {
                op::CHUNK => {
                    if let Err(e) = self.unpack(&record.body) {
                        self.damage.push((record.at, e.to_string()));
                    }
                    self.messages.sort_by_key(|message| message.time);
                }
                // Every file has the same.
                op::ATTACHMENT | op::METADATA if self.further => {}
                op::ATTACHMENT | op::METADATA => return Ok(Some(Item::Other(record))),
                opcode => self.learn(opcode, &record.body),
            }
            if !self.messages.is_empty() {
                return Ok(Some(Item::Messages));
            }
        }
    }

    fn unpack(&mut self, body: &[u8]) -> Result<(), mcap::McapError> {
        let header = chunk_header(body)?;
        self.latest = self.latest.max(header.message_end_time);
        if header.message_start_time > self.part.1 {
            return Ok(());
        }
        unpack_chunk(body, |opcode, body| self.learn(opcode, body))
    }

    /// Returns the messages of the batch, in order of time.
    pub fn messages(&self) -> impl Iterator<Item = (&RawMessage, &LogChannel, &[u8])> {
        self.messages.iter().filter_map(|message| {
            let bytes = self.bytes.get(message.span.0..message.span.1)?;
            Some((message, self.channels.get(&message.channel)?, bytes))
        })
    }

    pub(super) fn learn(&mut self, opcode: u8, body: &[u8]) {
        match parse_record(opcode, body) {
            Ok(Record::Message { header, data }) => {
                self.latest = self.latest.max(header.log_time);
                let start = self.bytes.len();
                self.bytes.extend_from_slice(&data);
                self.messages.push(RawMessage {
                    time: header.log_time,
                    channel: header.channel_id,
                    sequence: header.sequence,
                    span: (start, self.bytes.len()),
                });
            }
            Ok(Record::Header(header)) => self.profile = header.profile,
            Ok(Record::Schema { header, data }) => {
                self.schemas.insert(header.id, (header.name, header.encoding, data.into_owned()));
            }
            Ok(Record::Channel(channel)) => {
                let schema = self.schemas.get(&channel.schema_id).cloned().unwrap_or_default();
                let readable = schema.1 == "ros2msg" && channel.message_encoding == "cdr";
                let text = std::str::from_utf8(&schema.2).ok().filter(|_| readable);
                self.channels.insert(
                    channel.id,
                    LogChannel {
                        topic: channel.topic,
                        encoding: channel.message_encoding,
                        metadata: channel.metadata,
                        decoder: text.and_then(|text| Schema::parse(&schema.0, text).ok()),
                        schema,
                    },
                );
            }
            Ok(Record::Statistics(statistics)) => self.statistics = Some(statistics),
            Ok(Record::Footer(_)) => self.complete = true,
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
