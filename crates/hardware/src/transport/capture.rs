//! A capture of everything that a thread exchanges with an arm: for the report of a first day. Off unless started, and
//! then only for connections that this thread opens.

use std::cell::RefCell;

use dimos_core::clock::{Clock, Mono, MonotonicClock};

/// Most bytes that are kept; a capture that would have more says so.
const MOST: usize = 512 << 20;

/// A connection.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Connection {
    /// What is at its other end: `192.168.1.5:30004`, a device file, `udp`.
    pub peer: String,
    /// Whether each chunk is a whole message; else it is a part of a stream of bytes.
    pub datagrams: bool,
    /// This side's port, where the arm is given it.
    pub port: Option<u16>,
}

/// What one call sent or received.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Chunk {
    /// Time since the start [µs].
    pub at: u64,
    /// Index of the connection.
    pub connection: usize,
    /// Whether it went to the arm.
    pub sent: bool,
    /// The bytes; of a CAN frame its identifier (two bytes, big-endian) and its data.
    pub bytes: Vec<u8>,
}

/// What was captured.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Capture {
    /// The connections, in the order in which they were opened.
    pub connections: Vec<Connection>,
    /// What went over them, in the order of time.
    pub chunks: Vec<Chunk>,
    /// Whether there was too much to keep all of it.
    pub cut: bool,
}

struct Running {
    began: Mono,
    capture: Capture,
    size: usize,
}

thread_local! {
    static RUNNING: RefCell<Option<Running>> = const { RefCell::new(None) };
}

/// Starts to capture; discards what was captured before. Connections that are open already are not captured.
pub fn start() {
    let began = MonotonicClock.now();
    RUNNING.set(Some(Running { began, capture: Capture::default(), size: 0 }));
}

/// Returns the time since the start [µs]; 0 without a capture.
pub fn now() -> u64 {
    RUNNING.with_borrow(|running| running.as_ref().map_or(0, Running::now))
}

/// Ends the capture, and returns it.
pub fn finish() -> Capture {
    RUNNING.take().map(|running| running.capture).unwrap_or_default()
}

/// A connection's place in a capture; of no effect if none was running when it was opened.
#[derive(Debug, Clone, Copy, Default)]
pub struct Tap(Option<usize>);

impl Tap {
    /// Adds a connection to the capture that runs in this thread, if one does.
    pub fn open(peer: impl FnOnce() -> String, datagrams: bool, port: Option<u16>) -> Self {
        RUNNING.with_borrow_mut(|running| {
            let Some(Running { capture: Capture { connections, .. }, .. }) = running else { return Self(None) };
            connections.push(Connection { peer: peer(), datagrams, port });
            Self(Some(connections.len() - 1))
        })
    }

    /// Captures what was sent.
    pub fn sent(self, bytes: &[u8]) {
        self.keep(true, &[bytes]);
    }

    /// Captures what was received; nothing if that is nothing.
    pub fn received(self, bytes: &[u8]) {
        self.keep(false, &[bytes]);
    }

    /// Captures a message that is in two parts.
    pub fn keep(self, sent: bool, parts: &[&[u8]]) {
        let Some(connection) = self.0 else { return };
        RUNNING.with_borrow_mut(|running| {
            let (Some(running), true) = (running.as_mut(), parts.iter().any(|part| !part.is_empty())) else { return };
            let at = running.now();
            let bytes = parts.concat();
            running.size += bytes.len();
            if running.size > MOST {
                running.capture.cut = true;
                return;
            }
            running.capture.chunks.push(Chunk { at, connection, sent, bytes });
        });
    }
}

impl Running {
    fn now(&self) -> u64 {
        MonotonicClock.now().since(self.began).as_micros() as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_opened_while_it_runs_is_captured() {
        let before = Tap::open(|| "a".to_owned(), false, None);
        start();
        let during = Tap::open(|| "b".to_owned(), true, Some(7));
        before.sent(b"not this");
        during.sent(b"this");
        during.received(b"");
        during.received(b"and this");
        let capture = finish();
        assert_eq!(capture.connections, [Connection { peer: "b".to_owned(), datagrams: true, port: Some(7) }]);
        let kept: Vec<_> = capture.chunks.iter().map(|chunk| (chunk.sent, chunk.bytes.as_slice())).collect();
        assert_eq!(kept, [(true, &b"this"[..]), (false, b"and this")]);
        during.sent(b"too late");
        assert_eq!(finish(), Capture::default());
    }
}
