//! Attachments and metadata of a log, which may be damaged.

use std::collections::BTreeMap;

use mcap::parse_record;
use mcap::records::{AttachmentHeader, Metadata, Record, op};

use super::records::{RawRecord, RecordReader};

/// Name of the metadata of a copy that has what was damaged: attachments, and what is wrong with them.
pub const DAMAGED: &str = "damaged";

/// An attachment.
pub struct LoggedAttachment {
    /// Name, times and type.
    pub header: AttachmentHeader,
    /// Contents.
    pub data: Vec<u8>,
    /// What is wrong with it; its contents are what the file has.
    pub damage: Option<String>,
}

/// What a record beside the messages has.
pub enum Other {
    /// An attachment.
    Attachment(LoggedAttachment),
    /// Metadata.
    Metadata(Metadata),
    /// What was damaged in the log of which this one is a copy.
    Damaged(Metadata),
    /// A record that cannot be read: what it is, and why.
    Unreadable(&'static str, String),
}

/// Reads an attachment or metadata, and checks it. The one place for all verbs: none leaves damage out.
pub fn check(record: &RawRecord) -> Other {
    if record.opcode == op::ATTACHMENT {
        let unreadable = || Other::Unreadable("an attachment", "it cannot be read".to_owned());
        return of(&record.body).map_or_else(unreadable, Other::Attachment);
    }
    match parse_record(record.opcode, &record.body) {
        Ok(Record::Metadata(found)) if found.name == DAMAGED => Other::Damaged(found),
        Ok(Record::Metadata(found)) => Other::Metadata(found),
        Ok(_) => Other::Unreadable("metadata", "it is another record".to_owned()),
        Err(e) => Other::Unreadable("metadata", e.to_string()),
    }
}

impl Other {
    /// Returns what is damaged, as sentences; `at` is the position of the record [bytes].
    pub fn damage(&self, at: u64) -> Vec<String> {
        match self {
            Self::Attachment(found) => {
                found.damage.iter().map(|why| format!("{} at byte {at}: {why}", found.header.name)).collect()
            }
            Self::Metadata(_) => Vec::new(),
            Self::Damaged(found) => found.metadata.iter().map(|(name, why)| format!("{name}: {why}")).collect(),
            Self::Unreadable(what, why) => vec![format!("{what} at byte {at}: {why}")],
        }
    }
}

/// Returns the metadata of a name in a closed file, by its index.
pub fn metadata(records: &mut RecordReader, name: &str) -> Option<BTreeMap<String, String>> {
    let start = records.summary_start().ok()??;
    records.go_to(start).ok()?;
    let at = loop {
        let record = records.next_record().ok()??;
        if record.opcode == op::METADATA_INDEX
            && let Ok(Record::MetadataIndex(index)) = parse_record(record.opcode, &record.body)
            && index.name == name
        {
            break index.offset;
        }
    };
    records.go_to(at).ok()?;
    let record = records.next_record().ok()??;
    match parse_record(record.opcode, &record.body) {
        Ok(Record::Metadata(found)) => Some(found.metadata),
        _ => None,
    }
}

/// Reads an attachment record; `None` if it cannot be read at all.
pub fn of(body: &[u8]) -> Option<LoggedAttachment> {
    let damage = match parse(body) {
        Ok((header, data)) => {
            return Some(LoggedAttachment { header, data, damage: None });
        }
        Err(e) => e.to_string(),
    };
    // A checksum of 0 is none: the contents are there, right or wrong.
    let mut unchecked = body.to_vec();
    unchecked.last_chunk_mut::<4>()?.fill(0);
    let (header, data) = parse(&unchecked).ok()?;
    Some(LoggedAttachment { header, data, damage: Some(damage) })
}

fn parse(body: &[u8]) -> Result<(AttachmentHeader, Vec<u8>), mcap::McapError> {
    // The parser counts on a checksum after the header: two times, name, type, length of the data.
    let text = |at: usize| -> Option<usize> {
        let length = u32::from_le_bytes(body.get(at..at.checked_add(4)?)?.try_into().ok()?);
        at.checked_add(4)?.checked_add(length as usize)
    };
    let header = text(16).and_then(text).and_then(|end| end.checked_add(8 + 4));
    if header.is_none_or(|least| least > body.len()) {
        return Err(mcap::McapError::UnexpectedEoc);
    }
    match parse_record(op::ATTACHMENT, body)? {
        Record::Attachment { header, data, .. } => Ok((header, data.into_owned())),
        _ => Err(mcap::McapError::UnexpectedEoc),
    }
}
