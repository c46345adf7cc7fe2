//! Commands and replies over a byte stream: one at a time, with a timeout, closing the connection to a dead controller.

use std::time::Duration;

use super::Scan;
use super::serial::SerialLink;
use super::tcp::TcpLink;
use crate::hardware::adapter::{AdapterError, AdapterResult};

/// Close the connection after this many consecutive missing replies; a single lost reply is tolerated.
const LOST_AFTER: u32 = 3;

/// A byte stream in both directions.
pub trait ByteLink {
    /// Sends all of `bytes`.
    fn send(&mut self, bytes: &[u8]) -> AdapterResult<()>;
    /// Waits up to `timeout` for a frame that `scan` takes. `Timeout` leaves the link usable; other errors do not.
    fn receive<T>(&mut self, timeout: Duration, scan: impl FnMut(&[u8]) -> Scan<T>) -> AdapterResult<T>;
    /// Closes the link and discards unsent bytes.
    fn abort(self)
    where
        Self: Sized,
    {
    }
}

/// The methods of these links are those of the trait.
macro_rules! byte_links {
    ($($link:ty),+) => {$(
        impl ByteLink for $link {
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
    )+};
}

byte_links!(TcpLink, SerialLink);

/// Timeout and attempts of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Retry {
    /// Timeout of each attempt.
    pub each: Duration,
    /// Number of attempts: more than one only if executing the command twice does no harm.
    pub times: u32,
}

impl Retry {
    /// One attempt.
    pub const fn once(each: Duration) -> Self {
        Self { each, times: 1 }
    }
}

/// A connection to a controller that replies to each command.
#[derive(Debug)]
pub struct RequestReply<L> {
    link: Option<L>,
    /// Consecutive missing replies.
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

    /// Closes the connection.
    pub fn close(&mut self) {
        *self = Self::default();
    }

    /// Closes the connection and discards unsent bytes: the arm did not acknowledge them in time.
    pub fn abort(&mut self) {
        self.lost = 0;
        if let Some(link) = self.link.take() {
            link.abort();
        }
    }

    /// Returns whether the connection is open, as far as known.
    pub fn is_open(&self) -> bool {
        self.link.is_some()
    }

    /// Sends a command and waits for its reply: what `scan` takes, skipping everything else. Closes the connection
    /// after several consecutive missing replies, and when it breaks.
    pub fn request<T>(
        &mut self,
        command: &[u8],
        timeout: Retry,
        mut scan: impl FnMut(&[u8]) -> Scan<T>,
    ) -> AdapterResult<T> {
        let link = self.link.as_mut().ok_or(AdapterError::NotConnected)?;
        let mut ask = || link.send(command).and_then(|()| link.receive(timeout.each, &mut scan));
        let mut result = ask();
        for _ in 1..timeout.times {
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

    /// Replies according to a script; `None` for a missing reply.
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
    fn a_request_with_retries_is_sent_again_and_counts_once() {
        let mut line = RequestReply::default();
        let retried = Retry { each: Duration::ZERO, times: 3 };
        line.open(Script(vec![None, None, Some(9), None, None, None], 0));
        assert_eq!(line.request(b"?", retried, scan), Ok(9));
        assert_eq!(line.link.as_ref().map(|script| script.1), Some(3));
        assert!(matches!(line.request(b"?", retried, scan), Err(AdapterError::Timeout(_))));
        assert_eq!((line.is_open(), line.lost), (true, 1));
    }
}
