//! Commands and replies over a stream of bytes: one at a time, every wait bounded, a dead controller noticed.

use std::time::Duration;

use super::Scan;
use super::serial::SerialLink;
use super::tcp::TcpLink;
use crate::hardware::adapter::{AdapterError, AdapterResult};

/// So many replies in a row that do not come end the connection. One lost reply is not a lost arm.
const LOST_AFTER: u32 = 3;

/// A way for bytes to and fro.
pub trait ByteLink {
    /// Sends all of `bytes`.
    fn send(&mut self, bytes: &[u8]) -> AdapterResult<()>;
    /// Waits up to `timeout` for what `scan` takes. `Timeout` leaves the link usable; other errors do not.
    fn receive<T>(&mut self, timeout: Duration, scan: impl FnMut(&[u8]) -> Scan<T>) -> AdapterResult<T>;
    /// Closes the link and discards what has not left this computer.
    fn abort(self)
    where
        Self: Sized,
    {
    }
}

impl ByteLink for TcpLink {
    fn send(&mut self, bytes: &[u8]) -> AdapterResult<()> {
        self.send(bytes)
    }

    fn receive<T>(&mut self, timeout: Duration, scan: impl FnMut(&[u8]) -> Scan<T>) -> AdapterResult<T> {
        self.receive(timeout, scan)
    }

    fn abort(self) {
        self.abort();
    }
}

impl ByteLink for SerialLink {
    fn send(&mut self, bytes: &[u8]) -> AdapterResult<()> {
        self.send(bytes)
    }

    fn receive<T>(&mut self, timeout: Duration, scan: impl FnMut(&[u8]) -> Scan<T>) -> AdapterResult<T> {
        self.receive(timeout, scan)
    }

    fn abort(self) {
        self.abort();
    }
}

/// How long a reply is waited for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Retry {
    /// The longest wait after each time that the command is sent.
    pub each: Duration,
    /// How often it is sent: more than once only where being obeyed twice does no harm.
    pub times: u32,
}

impl Retry {
    /// The command is sent once.
    pub const fn once(each: Duration) -> Self {
        Self { each, times: 1 }
    }
}

/// The connection to a controller that answers each command, or none.
#[derive(Debug)]
pub struct RequestReply<L> {
    link: Option<L>,
    /// Replies in a row that did not come.
    lost: u32,
}

impl<L> Default for RequestReply<L> {
    fn default() -> Self {
        Self { link: None, lost: 0 }
    }
}

impl<L: ByteLink> RequestReply<L> {
    /// Takes a new connection.
    pub fn open(&mut self, link: L) {
        *self = Self { link: Some(link), lost: 0 };
    }

    /// Ends the connection.
    pub fn close(&mut self) {
        *self = Self::default();
    }

    /// Ends the connection and discards what has not left this computer: the arm did not acknowledge it in time.
    pub fn abort(&mut self) {
        self.lost = 0;
        if let Some(link) = self.link.take() {
            link.abort();
        }
    }

    /// Whether there is a connection, as far as is known.
    pub fn is_open(&self) -> bool {
        self.link.is_some()
    }

    /// Sends a command and waits for its reply: what `scan` takes, which must skip everything else. The connection ends
    /// when several replies in a row have not come, and when it breaks.
    pub fn request<T>(
        &mut self,
        command: &[u8],
        patience: Retry,
        mut scan: impl FnMut(&[u8]) -> Scan<T>,
    ) -> AdapterResult<T> {
        let link = self.link.as_mut().ok_or(AdapterError::NotConnected)?;
        let mut ask = || link.send(command).and_then(|()| link.receive(patience.each, &mut scan));
        let mut result = ask();
        for _ in 1..patience.times {
            if !matches!(result, Err(AdapterError::Timeout(_))) {
                break;
            }
            result = ask();
        }
        match result {
            Ok(_) => self.lost = 0,
            Err(AdapterError::Timeout(_)) if self.lost + 1 < LOST_AFTER => self.lost += 1,
            Err(_) => self.abort(),
        }
        result
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Answers as the script says: `None` for a reply that does not come.
    struct Script(Vec<Option<u8>>, usize);

    impl ByteLink for Script {
        fn send(&mut self, _: &[u8]) -> AdapterResult<()> {
            self.1 += 1;
            Ok(())
        }

        fn receive<T>(&mut self, _: Duration, mut scan: impl FnMut(&[u8]) -> Scan<T>) -> AdapterResult<T> {
            match self.0.remove(0).map(|byte| scan(&[byte])) {
                Some(Scan::Take(_, reply)) => Ok(reply),
                Some(_) => Err(AdapterError::Io("broken".into())),
                None => Err(AdapterError::Timeout("late".into())),
            }
        }
    }

    fn scan(bytes: &[u8]) -> Scan<u8> {
        if bytes[0] == 0 { Scan::Skip(1) } else { Scan::Take(1, bytes[0]) }
    }

    #[test]
    fn only_replies_missing_in_a_row_end_it() {
        let mut line = RequestReply::default();
        let once = Retry::once(Duration::ZERO);
        assert_eq!(line.request(b"?", once, scan), Err(AdapterError::NotConnected));
        line.open(Script(vec![None, None, Some(7), None, None, None], 0));
        let answers: Vec<_> = (0..6).map(|_| (line.request(b"?", once, scan).ok(), line.is_open())).collect();
        let late = (None, true);
        assert_eq!(answers, [late, late, (Some(7), true), late, late, (None, false)]);
        line.open(Script(vec![Some(0)], 0));
        assert!(line.request(b"?", once, scan).is_err() && !line.is_open(), "a broken link ends at once");
    }

    #[test]
    fn a_patient_request_is_sent_again_and_counts_once() {
        let mut line = RequestReply::default();
        let patient = Retry { each: Duration::ZERO, times: 3 };
        line.open(Script(vec![None, None, Some(9), None, None, None], 0));
        assert_eq!(line.request(b"?", patient, scan), Ok(9));
        assert_eq!(line.link.as_ref().map(|script| script.1), Some(3));
        assert!(matches!(line.request(b"?", patient, scan), Err(AdapterError::Timeout(_))));
        assert_eq!((line.is_open(), line.lost), (true, 1));
    }
}
