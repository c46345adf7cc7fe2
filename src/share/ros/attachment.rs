//! What rmw_zenoh attaches to messages, requests and replies: number, time, and the number of the sender.

use std::sync::atomic::{AtomicI64, Ordering};

use zenoh::bytes::ZBytes;

/// Length of the number of a sender [bytes].
const GID: usize = 16;
/// Length of an attachment [bytes].
const LENGTH: usize = 8 + 8 + 1 + GID;

/// A sender of messages.
#[derive(Debug)]
pub struct Sender {
    gid: [u8; GID],
    sequence: AtomicI64,
}

impl Sender {
    /// Creates a part of the node of a session. `entity`: its number in it.
    pub fn new(zid: [u8; GID], entity: u32) -> Self {
        let mut gid = zid;
        // Sessions have different numbers, and so have the parts of one.
        gid.iter_mut().zip(entity.to_le_bytes()).for_each(|(octet, part)| *octet ^= part);
        Self { gid, sequence: AtomicI64::new(1) }
    }

    /// Returns the attachment of the next message. `now`: time since the Unix epoch [ns].
    pub fn next(&self, now: u64) -> ZBytes {
        let mut bytes = Vec::with_capacity(LENGTH);
        bytes.extend(self.sequence.fetch_add(1, Ordering::Relaxed).to_le_bytes());
        bytes.extend(now.to_le_bytes());
        bytes.push(GID as u8);
        bytes.extend(self.gid);
        bytes.into()
    }
}

/// Returns whether this can be the attachment of a request: a reply returns it, so that the client knows it again.
pub fn is_of_request(bytes: &[u8]) -> bool {
    bytes.len() == LENGTH && bytes.get(16) == Some(&(GID as u8))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_are_counted_and_senders_differ() {
        let (one, other) = (Sender::new([7; GID], 1), Sender::new([7; GID], 2));
        let first = one.next(3).to_bytes().into_owned();
        assert_eq!(first[..17], [1, 0, 0, 0, 0, 0, 0, 0, 3, 0, 0, 0, 0, 0, 0, 0, 16]);
        assert_eq!(one.next(3).to_bytes()[0], 2);
        assert_ne!(first[17..], other.next(3).to_bytes()[17..]);
        assert!(is_of_request(&first) && !is_of_request(&first[1..]) && !is_of_request(&[]));
    }
}
