//! Copies what can be read of a log to a new one: a part of a log, or what a crash left.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Error};
use std::path::Path;

use mcap::records::{AttachmentHeader, MessageHeader, Metadata};
use mcap::{Attachment, McapError, WriteOptions, Writer};

use super::CONTINUES;
use super::attachment::{DAMAGED, Other, check};
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

/// What a copy says of itself.
#[derive(Debug, Clone, Copy, Default)]
pub struct Label<'a> {
    /// The log that it is a part of.
    pub part_of: Option<&'a str>,
    /// Its profile; `None`: that of the log.
    pub profile: Option<&'a str>,
}

/// Copies the messages of a log between two Unix times [ns] to a new file, with all attachments and metadata, and, at
/// its beginning, the latest state before. Calls `progress` after each batch.
pub fn copy(
    scan: &mut Scan,
    to: &Path,
    label: Label<'_>,
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
    let options = WriteOptions::new()
        .profile(label.profile.unwrap_or(scan.profile()))
        .library(concat!("dimos/", env!("CARGO_PKG_VERSION")));
    let options = options.compression_level(1).compression_threads(0).disable_seeking(true);
    let mut copy = Copy {
        writer: options.create(BufWriter::new(file)).map_err(refused)?,
        ids: BTreeMap::new(),
        before: BTreeMap::new(),
        added: Vec::new(),
        others: BTreeMap::new(),
        damaged: BTreeMap::new(),
        written: Written::default(),
    };
    let (from, until) = scan.part();
    let mut in_part = false;
    while let Some(item) = scan.next_item()? {
        match item {
            Item::Other(file, record) => {
                let other = check(&record);
                other.damage(record.at).into_iter().for_each(|damage| scan.lacks(damage));
                copy.other(file, other, label.part_of).map_err(refused)?;
            }
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
    // Channels without messages are part of a log, too.
    for (id, channel) in &scan.channels {
        copy.id(*id, channel).map_err(refused)?;
    }
    if !copy.damaged.is_empty() {
        let metadata = std::mem::take(&mut copy.damaged);
        copy.writer.write_metadata(&Metadata { name: DAMAGED.to_owned(), metadata }).map_err(refused)?;
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
    /// Names, lengths and checksums of the attachments and metadata that were copied, and the file of the first.
    others: BTreeMap<(String, usize, u32), usize>,
    /// What is damaged, and how.
    damaged: BTreeMap<String, String>,
    written: Written,
}

impl Copy {
    /// Copies an attachment or metadata of a file. Every file of a split log has the same: they are copied once.
    fn other(&mut self, file: usize, other: Other, part_of: Option<&str>) -> Result<(), McapError> {
        let mut is_new = |name: &str, length, sum| {
            let first = *self.others.entry((name.to_owned(), length, sum)).or_insert(file);
            first == file
        };
        match other {
            Other::Attachment(found) => {
                let AttachmentHeader { log_time, create_time, name, media_type } = found.header;
                if !is_new(&name, found.data.len(), crc32fast::hash(&found.data)) {
                    return Ok(());
                }
                let data = found.data.into();
                let kept = Attachment { log_time, create_time, name: name.clone(), media_type, data };
                self.writer.attach(&kept)?;
                let damage = found.damage.map(|why| (name, format!("{why}; its bytes are kept, and may be wrong")));
                self.damaged.extend(damage);
            }
            Other::Metadata(Metadata { name, mut metadata }) => {
                // The copy has all files in one.
                if name == CONTINUES || !is_new(&name, 0, sum_of(&name, &metadata)) {
                    return Ok(());
                }
                if let Some(whole) = part_of.filter(|_| name == "dimos") {
                    metadata.insert(PART_OF.to_owned(), whole.to_owned());
                }
                self.writer.write_metadata(&Metadata { name, metadata })?;
            }
            Other::Damaged(Metadata { metadata, .. }) => self.damaged.extend(metadata),
            Other::Unreadable(what, why) => {
                drop(self.damaged.insert(what.to_owned(), format!("{why}, and is left out")))
            }
        }
        Ok(())
    }

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
        let put = |(message, channel, bytes): &(RawMessage, LogChannel, Vec<u8>)| {
            self.put(RawMessage { time, published: time, ..*message }, channel, bytes)
        };
        kept.iter().try_for_each(put)
    }

    fn put(&mut self, message: RawMessage, channel: &LogChannel, bytes: &[u8]) -> Result<(), McapError> {
        let channel_id = self.id(message.channel, channel)?;
        let RawMessage { time: log_time, published: publish_time, sequence, .. } = message;
        self.writer.write_to_known_channel(&MessageHeader { channel_id, sequence, log_time, publish_time }, bytes)
    }

    /// Returns the id of a channel in the new file, which has it from then on.
    fn id(&mut self, channel_id: u16, channel: &LogChannel) -> Result<u16, McapError> {
        if let Some(id) = self.ids.get(&channel_id) {
            return Ok(*id);
        }
        let (name, encoding, text) = &channel.schema;
        let schema = if name.is_empty() { 0 } else { self.writer.add_schema(name, encoding, text)? };
        let id = self.writer.add_channel(schema, &channel.topic, &channel.encoding, &channel.metadata)?;
        self.ids.insert(channel_id, id);
        Ok(id)
    }
}

/// Returns the checksum of metadata. That of a run differs from file to file by their numbers only.
fn sum_of(name: &str, metadata: &BTreeMap<String, String>) -> u32 {
    let mut sum = crc32fast::Hasher::new();
    for (key, value) in metadata.iter().filter(|_| name != "dimos") {
        [key, value].into_iter().for_each(|text| sum.update(format!("{}:{text}", text.len()).as_bytes()));
    }
    sum.finalize()
}
