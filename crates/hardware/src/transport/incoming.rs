//! Frames from a byte stream.

use std::ops::Range;
use std::time::{Duration, Instant};

use crate::adapter::{AdapterError, AdapterResult};

/// Maximum size of an incomplete frame.
pub(super) const BUFFER: usize = 4096;

/// Result of scanning the front of the received bytes.
#[derive(Debug, Clone, PartialEq)]
pub enum Scan<T> {
    /// The beginning of a frame: more bytes are needed.
    More,
    /// This many bytes (at least 1) are not the expected frame. They may be more than have arrived.
    Skip(usize),
    /// The expected frame, and its length.
    Take(usize, T),
}

impl<T> Scan<T> {
    /// Maps the frame.
    pub fn map<U>(self, f: impl FnOnce(T) -> U) -> Scan<U> {
        match self {
            Self::More => Scan::More,
            Self::Skip(n) => Scan::Skip(n),
            Self::Take(n, frame) => Scan::Take(n, f(frame)),
        }
    }
}

/// Received bytes that are not processed yet.
#[derive(Debug)]
pub(super) struct Incoming {
    buffer: Vec<u8>,
    filled: Range<usize>,
    /// Number of bytes to skip that have not arrived yet.
    skip: usize,
}

impl Incoming {
    pub(super) fn new() -> Self {
        Self { buffer: vec![0; BUFFER], filled: 0..0, skip: 0 }
    }

    /// Returns the first frame that `scan` takes from the received bytes. Skipped bytes are dropped.
    pub(super) fn next<T>(&mut self, mut scan: impl FnMut(&[u8]) -> Scan<T>) -> Option<T> {
        while !self.filled.is_empty() {
            match scan(self.buffer.get(self.filled.clone()).unwrap_or_default()) {
                Scan::More => break,
                Scan::Skip(n) => self.used(n.max(1)),
                Scan::Take(n, frame) => {
                    self.used(n.max(1));
                    return Some(frame);
                }
            }
        }
        None
    }

    /// Lets `read` append bytes; it returns how many. `Protocol` if there is no room.
    pub(super) fn fill(
        &mut self,
        peer: &str,
        read: impl FnOnce(&mut [u8]) -> AdapterResult<usize>,
    ) -> AdapterResult<usize> {
        self.buffer.copy_within(self.filled.clone(), 0);
        self.filled = 0..self.filled.len();
        let room = self.buffer.get_mut(self.filled.end..).unwrap_or_default();
        if room.is_empty() {
            return Err(AdapterError::Protocol(format!("{peer} sent a frame that is too long")));
        }
        let n = read(room)?.min(room.len());
        self.filled.end += n;
        let skip = std::mem::take(&mut self.skip);
        self.used(skip);
        Ok(n)
    }

    /// Waits up to `timeout` for a frame that `scan` takes. `read` waits for bytes for that time (0: not at all)
    /// and returns 0 if none arrived. What has arrived when the time is over counts: in a process that is stopped and
    /// continued, the wait ends as if interrupted.
    pub(super) fn receive<T>(
        &mut self,
        peer: &str,
        timeout: Duration,
        mut scan: impl FnMut(&[u8]) -> Scan<T>,
        mut read: impl FnMut(&mut [u8], Duration) -> AdapterResult<usize>,
    ) -> AdapterResult<T> {
        let deadline = Instant::now() + timeout;
        let (mut left, mut over) = (timeout, false);
        loop {
            if let Some(frame) = self.next(&mut scan) {
                return Ok(frame);
            }
            if over {
                return Err(AdapterError::Timeout(format!("{peer} did not answer within {timeout:?}")));
            }
            over = left.is_zero();
            self.fill(peer, |room| read(room, left))?;
            left = deadline.saturating_duration_since(Instant::now());
        }
    }

    /// Discards all received bytes.
    pub(super) fn clear(&mut self) {
        self.filled = 0..0;
        self.skip = 0;
    }

    fn used(&mut self, n: usize) {
        let now = n.min(self.filled.len());
        self.filled.start += now;
        self.skip = n - now;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_skipped_may_not_have_arrived_yet() {
        let mut incoming = Incoming::new();
        // A byte that says how long its frame is; frames of more than 9 bytes are skipped.
        let scan = |bytes: &[u8]| match bytes {
            [length, ..] if *length >= 10 => Scan::Skip(usize::from(*length)),
            [length, ..] if bytes.len() >= usize::from(*length) => Scan::Take(usize::from(*length), bytes.len()),
            _ => Scan::More,
        };
        let arrive = |incoming: &mut Incoming, bytes: &[u8]| {
            incoming.fill("test", |room| {
                room[..bytes.len()].copy_from_slice(bytes);
                Ok(bytes.len())
            })
        };
        arrive(&mut incoming, &[20, 1, 1, 1]).unwrap();
        assert_eq!(incoming.next(scan), None);
        arrive(&mut incoming, &[1; 10]).unwrap();
        assert_eq!(incoming.next(scan), None);
        arrive(&mut incoming, &[[1; 6].as_slice(), &[3, 0, 0]].concat()).unwrap();
        assert_eq!(incoming.next(scan), Some(3));
    }
}
