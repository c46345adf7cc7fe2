//! Copies what can be read of a log to a new one: a part of a log, or what a crash left.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Error};
use std::path::Path;

use mcap::records::{MessageHeader, Metadata, Record};
use mcap::{Attachment, McapError, WriteOptions, Writer, parse_record};

use super::records::ReplayError;
use super::scan::{Item, LogChannel, RawMessage, Scan};

/// Key in the metadata of a part of a log: the log that it was cut out of.
pub const PART_OF: &str = "part_of";
/// Topics whose messages are moments, not states: they are not repeated at the beginning of a part.
const MOMENTS: [&str; 5] = ["/dimos/tick", "/dimos/events", "/dimos/requests", "/rosout", "/joint_trajectory"];
/// A topic whose messages add to each other.
const ADDED: &str = "/markers";
/// Maximum number of those that are repeated.
const MAX_ADDED: usize = 10_000;

/// Why a log cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum RewriteError {
    /// The log cannot be read.
    #[error(transparent)]
    Read(#[from] ReplayError),
    /// The new file cannot be written.
    #[error("cannot write {path}: {reason}\nhint: {}", if *exists { "choose another file with -o FILE, or remove it" } else { "check the folder and its free space" })]
    Write {
        /// The file.
        path: String,
        /// The error.
        reason: String,
        /// Whether it is there already.
        exists: bool,
    },
}

/// What was written.
#[derive(Debug, Default)]
pub struct Written {
    /// Messages.
    pub messages: u64,
    /// First and last time of those that are not repeated [ns].
    pub span: Option<(u64, u64)>,
}

/// Copies the messages of a log between two Unix times [ns] to a new file, with all attachments and metadata, and, at
/// its beginning, the latest state before. Calls `progress` after each batch.
pub fn copy(
    scan: &mut Scan,
    to: &Path,
    part_of: Option<&str>,
    mut progress: impl FnMut(&Scan),
) -> Result<Written, RewriteError> {
    let failed = |e: Error| {
        let exists = e.kind() == std::io::ErrorKind::AlreadyExists;
        RewriteError::Write { path: to.display().to_string(), reason: e.to_string(), exists }
    };
    let refused = |e: McapError| match e {
        McapError::Io(e) => failed(e),
        e => RewriteError::Write { path: to.display().to_string(), reason: e.to_string(), exists: false },
    };
    let file = File::create_new(to).map_err(failed)?;
    let options = WriteOptions::new().profile("ros2").library(concat!("dimos/", env!("CARGO_PKG_VERSION")));
    let options = options.compression_level(1).compression_threads(0).disable_seeking(true);
    let mut copy = Copy {
        writer: options.create(BufWriter::new(file)).map_err(refused)?,
        ids: BTreeMap::new(),
        before: BTreeMap::new(),
        added: Vec::new(),
        written: Written::default(),
    };
    let (from, until) = scan.part;
    let mut in_part = false;
    while let Some(item) = scan.next_item()? {
        match item {
            Item::Other(record) => match parse_record(record.opcode, &record.body) {
                Ok(Record::Attachment { header, data, .. }) => copy
                    .writer
                    .attach(&Attachment {
                        log_time: header.log_time,
                        create_time: header.create_time,
                        name: header.name,
                        media_type: header.media_type,
                        data,
                    })
                    .map_err(refused)?,
                Ok(Record::Metadata(Metadata { name, mut metadata })) => {
                    if let Some(whole) = part_of.filter(|_| name == "dimos") {
                        metadata.insert(PART_OF.to_owned(), whole.to_owned());
                    }
                    copy.writer.write_metadata(&Metadata { name, metadata }).map_err(refused)?;
                }
                _ => {}
            },
            Item::Messages => {
                for (message, channel, bytes) in scan.messages() {
                    if message.time < from {
                        copy.keep(*message, channel, bytes);
                    } else if message.time <= until {
                        if !std::mem::replace(&mut in_part, true) {
                            copy.repeat(from).map_err(refused)?;
                        }
                        copy.put(*message, channel, bytes).map_err(refused)?;
                        copy.written.messages += 1;
                        let (start, end) = copy.written.span.unwrap_or((message.time, message.time));
                        copy.written.span = Some((start.min(message.time), end.max(message.time)));
                    }
                }
                progress(scan);
            }
        }
    }
    copy.writer.finish().map_err(refused)?;
    let file = copy.writer.into_inner().into_inner().map_err(|e| failed(e.into_error()))?;
    file.sync_all().map_err(failed)?;
    Ok(copy.written)
}

struct Copy {
    writer: Writer<BufWriter<File>>,
    /// Ids of the channels in the new file.
    ids: BTreeMap<u16, u16>,
    /// The latest message of each channel before the part.
    before: BTreeMap<u16, (RawMessage, LogChannel, Vec<u8>)>,
    added: Vec<(RawMessage, LogChannel, Vec<u8>)>,
    written: Written,
}

impl Copy {
    fn keep(&mut self, message: RawMessage, channel: &LogChannel, bytes: &[u8]) {
        let topic = channel.topic.as_str();
        if topic == ADDED && self.added.len() < MAX_ADDED {
            self.added.push((message, channel.clone(), bytes.to_vec()));
        } else if let Some((last, _, kept)) = self.before.get_mut(&message.channel) {
            // In place: there may be millions.
            *last = message;
            kept.clear();
            kept.extend_from_slice(bytes);
        } else if topic != ADDED && !MOMENTS.contains(&topic) {
            self.before.insert(message.channel, (message, channel.clone(), bytes.to_vec()));
        }
    }

    /// Writes the state before the part, at its beginning.
    fn repeat(&mut self, time: u64) -> Result<(), McapError> {
        let mut kept: Vec<_> = std::mem::take(&mut self.before).into_values().chain(self.added.drain(..)).collect();
        kept.sort_by_key(|(message, ..)| message.time);
        kept.iter().try_for_each(|(message, channel, bytes)| self.put(RawMessage { time, ..*message }, channel, bytes))
    }

    fn put(&mut self, message: RawMessage, channel: &LogChannel, bytes: &[u8]) -> Result<(), McapError> {
        let id = match self.ids.get(&message.channel) {
            Some(id) => *id,
            None => {
                let (name, encoding, text) = &channel.schema;
                let schema = if name.is_empty() { 0 } else { self.writer.add_schema(name, encoding, text)? };
                let id = self.writer.add_channel(schema, &channel.topic, &channel.encoding, &channel.metadata)?;
                self.ids.insert(message.channel, id);
                id
            }
        };
        let (time, sequence) = (message.time, message.sequence);
        let header = MessageHeader { channel_id: id, sequence, log_time: time, publish_time: time };
        self.writer.write_to_known_channel(&header, bytes)
    }
}
