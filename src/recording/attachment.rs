//! An attachment of a log, which may be damaged.

use mcap::parse_record;
use mcap::records::{AttachmentHeader, Record, op};

/// An attachment.
pub struct LoggedAttachment {
    /// Name, times and type.
    pub header: AttachmentHeader,
    /// Contents.
    pub data: Vec<u8>,
    /// What is wrong with it; its contents are what the file has.
    pub damage: Option<String>,
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
