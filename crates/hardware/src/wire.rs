//! The messages of an arm's protocol, for captures: what `dimos adapter replay` reads of what a controller sent, and
//! compares with what the emulator sends.

use crate::transport::Scan;

/// How captured bytes become messages.
#[derive(Debug, Clone, Copy)]
pub struct Wire {
    /// Returns the connections of an arm at an address: a name, and what is at the other end as a capture has it.
    pub connections: fn(address: &str) -> Vec<(&'static str, String)>,
    /// Finds the next message at the front of the bytes of one direction of a connection; of a datagram all of it. What
    /// is skipped counts as damaged.
    pub scan: fn(place: Place<'_>, bytes: &[u8]) -> Scan<Message>,
    /// Makes the checksum of a message right again, after bytes of it were replaced.
    pub mend: fn(place: Place<'_>, message: &mut [u8]),
}

/// Where bytes were captured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Place<'a> {
    /// Name of the connection.
    pub connection: &'a str,
    /// Whether they went to the arm.
    pub sent: bool,
}

/// What a decoder made of a message.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Message {
    /// Its kind, as the vendor's documents call it if they do; empty for one that the adapter does not read.
    pub name: String,
    /// Status of a response; 0 for success.
    pub status: i64,
    /// What the adapter's decoder does not take.
    pub wrong: Option<String>,
}

impl Message {
    /// Returns a message without status.
    pub fn named(name: impl Into<String>) -> Self {
        Self { name: name.into(), ..Self::default() }
    }

    /// Adds the status of a response.
    pub fn status(self, status: i64) -> Self {
        Self { status, ..self }
    }

    /// Marks it as wrong if the adapter's decoder does not take it.
    pub fn decoded(self, decoded: bool) -> Self {
        let wrong = (!decoded).then(|| "the adapter's decoder does not take it".to_owned());
        Self { wrong, ..self }
    }
}

/// Keeps a message without checksum as it is.
pub fn no_checksum(_: Place<'_>, _: &mut [u8]) {}

/// Finds a line of text, and names it by `name`.
pub fn line(bytes: &[u8], name: impl FnOnce(&str) -> Message) -> Scan<Message> {
    match bytes.iter().position(|byte| *byte == b'\n') {
        None => Scan::More,
        Some(end) => Scan::Take(end + 1, name(&String::from_utf8_lossy(bytes.get(..end).unwrap_or_default()))),
    }
}

/// Takes all of a datagram.
pub fn whole(bytes: &[u8], message: Message) -> Scan<Message> {
    Scan::Take(bytes.len(), message)
}
