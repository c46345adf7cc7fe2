//! Commands and replies over a byte stream: one at a time, with a timeout, closing the connection to a dead controller.
//!
//! On a bus ([`RequestReply::half_duplex`]) many devices share one line and replies carry no number: what arrived late
//! is discarded before the next request, and the line's own echo is skipped. Commands without a reply, and one request
//! that several devices answer, are [`RequestReply::tell`] and [`RequestReply::gather`].

use std::time::{Duration, Instant};

use super::Scan;
use super::serial::SerialLink;
use super::tcp::TcpLink;
use crate::adapter::{AdapterError, AdapterResult};

/// Close the connection after this many consecutive missing replies; a single lost reply is tolerated.
const LOST_AFTER: u32 = 3;

/// A byte stream in both directions.
pub trait ByteLink {
    /// Sends all of `bytes`.
    fn send(&mut self, bytes: &[u8]) -> AdapterResult<()>;
    /// Waits up to `timeout` for a frame that `scan` takes. `Timeout` leaves the link usable; other errors do not.
    fn receive<T>(&mut self, timeout: Duration, scan: impl FnMut(&[u8]) -> Scan<T>) -> AdapterResult<T>;
    /// Discards everything received so far.
    fn drain(&mut self) -> AdapterResult<()>;
    /// Makes an exchange, a command with its replies. Where others use the line it waits for its turn.
    fn exchange<T>(&mut self, make: impl FnOnce(&mut Self) -> T) -> T {
        make(self)
    }
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

            fn drain(&mut self) -> AdapterResult<()> {
                self.drain()
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

/// What must be done around the bytes of a command.
#[derive(Debug, Clone, Copy, Default)]
struct Bus {
    /// Replies carry no number: older bytes are discarded before a command.
    drain: bool,
    /// The line returns what is sent.
    echo: bool,
}

/// A connection to a controller that replies to each command.
#[derive(Debug)]
pub struct RequestReply<L> {
    link: Option<L>,
    bus: Bus,
    /// Consecutive missing replies.
    lost: u32,
}

impl<L> Default for RequestReply<L> {
    fn default() -> Self {
        Self { link: None, bus: Bus::default(), lost: 0 }
    }
}

/// How long the echo of a command may take. The line's rate is no matter: 256 bytes take 22 ms at 115 200 bit/s.
const ECHO_TIMEOUT: Duration = Duration::from_millis(100);

/// Sends a command, and takes its echo.
fn put<L: ByteLink>(link: &mut L, bus: Bus, command: &[u8]) -> AdapterResult<()> {
    if bus.drain {
        link.drain()?;
    }
    link.send(command)?;
    if !bus.echo {
        return Ok(());
    }
    // Noise may precede it.
    let echo = |bytes: &[u8]| match bytes.get(..command.len()) {
        Some(front) if front == command => Scan::Take(command.len(), ()),
        None if command.starts_with(bytes) => Scan::More,
        _ => Scan::Skip(1),
    };
    link.receive(ECHO_TIMEOUT, echo).map_err(|error| match error {
        AdapterError::Timeout(text) => AdapterError::Timeout(format!("{text}: the line returned no echo")),
        error => error,
    })
}

impl<L: ByteLink> RequestReply<L> {
    /// Creates one for a half-duplex bus: everything received is discarded before each command. `echo`: the line
    /// returns what is sent, as two-wire adapters do.
    pub fn half_duplex(echo: bool) -> Self {
        Self { bus: Bus { drain: true, echo }, ..Self::default() }
    }

    /// Takes a new connection.
    pub fn open(&mut self, link: L) {
        (self.link, self.lost) = (Some(link), 0);
    }

    /// Closes the connection.
    pub fn close(&mut self) {
        (self.link, self.lost) = (None, 0);
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
        self.attempt(timeout.times, |link, bus| {
            put(link, bus, command)?;
            link.receive(timeout.each, &mut scan)
        })
    }

    /// Sends a command that no device answers, such as a write to all of them. That it arrived is not known.
    pub fn tell(&mut self, command: &[u8]) -> AdapterResult<()> {
        self.attempt(1, |link, bus| put(link, bus, command))
    }

    /// Sends a command that several devices answer, one after the other. `scan` takes replies as in
    /// [`RequestReply::request`]; `take` gets each, and returns whether it is the one of a device that had not answered
    /// yet: an attempt ends after `devices` of them. `timeout.each` is for all replies of an attempt. A retry asks all
    /// devices again.
    pub fn gather<T>(
        &mut self,
        command: &[u8],
        timeout: Retry,
        devices: usize,
        mut scan: impl FnMut(&[u8]) -> Scan<T>,
        mut take: impl FnMut(T) -> bool,
    ) -> AdapterResult<()> {
        let mut answered = 0;
        self.attempt(timeout.times, |link, bus| {
            put(link, bus, command)?;
            let until = Instant::now() + timeout.each;
            while answered < devices {
                let left = until.saturating_duration_since(Instant::now());
                match link.receive(left, &mut scan) {
                    Ok(reply) => answered += usize::from(take(reply)),
                    Err(AdapterError::Timeout(text)) => {
                        return Err(AdapterError::Timeout(format!("{text}: {answered} of {devices} devices answered")));
                    }
                    Err(error) => return Err(error),
                }
            }
            Ok(())
        })
    }

    /// The same, where some devices may be lost: with a reply of any of them the line works. Returns how many have
    /// answered; an error if none has.
    pub fn gather_some<T>(
        &mut self,
        command: &[u8],
        timeout: Retry,
        devices: usize,
        scan: impl FnMut(&[u8]) -> Scan<T>,
        mut take: impl FnMut(T) -> bool,
    ) -> AdapterResult<usize> {
        let mut answered = 0;
        let result = self.gather(command, timeout, devices, scan, |reply| {
            let new = take(reply);
            answered += usize::from(new);
            new
        });
        match result {
            Err(AdapterError::Timeout(_)) if answered > 0 && self.link.is_some() => {
                self.lost = 0;
                Ok(answered)
            }
            result => result.map(|()| answered),
        }
    }

    /// Makes up to `times` attempts, as long as replies are missing. Closes the connection after several consecutive
    /// failures, and when it breaks.
    fn attempt<T>(&mut self, times: u32, mut make: impl FnMut(&mut L, Bus) -> AdapterResult<T>) -> AdapterResult<T> {
        let (bus, link) = (self.bus, self.link.as_mut().ok_or(AdapterError::NotConnected)?);
        let mut result = link.exchange(|link| make(link, bus));
        for _ in 1..times {
            if !matches!(result, Err(AdapterError::Timeout(_))) {
                break;
            }
            result = link.exchange(|link| make(link, bus));
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

        fn drain(&mut self) -> AdapterResult<()> {
            Ok(())
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

    /// A line of devices 1 to 3. Each answers `?` with its number, all of them if it is sent without one; `!` is not
    /// answered. Answers to a request in `late` arrive with those to the next one.
    #[derive(Default)]
    struct Line {
        echo: bool,
        arrived: Vec<u8>,
        late: Vec<usize>,
        requests: usize,
        delayed: Vec<u8>,
        silent: Option<u8>,
    }

    impl ByteLink for Line {
        fn send(&mut self, bytes: &[u8]) -> AdapterResult<()> {
            let mut answers = match bytes {
                [b'?'] => vec![1, 2, 3],
                [b'?', device] => vec![*device],
                _ => vec![],
            };
            answers.retain(|device| Some(*device) != self.silent);
            if self.echo {
                self.arrived.extend(bytes);
            }
            // Those of the request before come first.
            self.arrived.append(&mut self.delayed);
            if self.late.contains(&self.requests) {
                self.delayed = answers
            } else {
                self.arrived.append(&mut answers)
            }
            self.requests += 1;
            Ok(())
        }

        fn receive<T>(&mut self, _: Duration, mut scan: impl FnMut(&[u8]) -> Scan<T>) -> AdapterResult<T> {
            while !self.arrived.is_empty() {
                match scan(&self.arrived) {
                    Scan::More => break,
                    Scan::Skip(n) => drop(self.arrived.drain(..n)),
                    Scan::Take(n, reply) => {
                        self.arrived.drain(..n);
                        return Ok(reply);
                    }
                }
            }
            Err(AdapterError::Timeout("late".into()))
        }

        fn drain(&mut self) -> AdapterResult<()> {
            // What was delayed has arrived in the meantime.
            self.delayed.clear();
            self.arrived.clear();
            Ok(())
        }
    }

    fn device(bytes: &[u8]) -> Scan<u8> {
        if bytes[0] <= 3 { Scan::Take(1, bytes[0]) } else { Scan::Skip(1) }
    }

    #[test]
    fn on_a_bus_a_late_reply_is_not_taken_for_the_next_one() {
        let once = Retry::once(Duration::ZERO);
        let ask = |mut line: RequestReply<Line>| {
            line.open(Line { late: vec![0], ..Line::default() });
            [1, 2, 3].map(|n| line.request(&[b'?', n], once, device).ok())
        };
        assert_eq!(ask(RequestReply::half_duplex(false)), [None, Some(2), Some(3)]);
        assert_eq!(ask(RequestReply::default()), [None, Some(1), Some(2)], "without a drain each is one behind");
    }

    #[test]
    fn the_echo_of_a_command_is_no_reply() {
        let once = Retry::once(Duration::ZERO);
        let mut line = RequestReply::half_duplex(true);
        // The echo of this command contains what looks like a reply.
        line.open(Line { echo: true, ..Line::default() });
        assert_eq!(line.tell(&[b'!', 2]), Ok(()));
        assert_eq!(line.request(&[b'?', 3], once, device), Ok(3));
        line.open(Line::default());
        let error = line.tell(b"!").unwrap_err();
        assert!(error.to_string().contains("no echo"), "{error}");
    }

    #[test]
    fn several_devices_answer_one_request() {
        let mut line = RequestReply::half_duplex(false);
        line.open(Line::default());
        let twice = Retry { each: Duration::from_secs(1), times: 2 };
        let mut heard = Vec::new();
        let mut collect = |line: &mut RequestReply<Line>| {
            heard.clear();
            let result = line.gather(b"?", twice, 3, device, |n| {
                let new = !heard.contains(&n);
                heard.extend(new.then_some(n));
                new
            });
            (result, heard.clone())
        };
        assert_eq!(collect(&mut line), (Ok(()), vec![1, 2, 3]));
        line.open(Line { silent: Some(2), ..Line::default() });
        let (result, heard) = collect(&mut line);
        let error = result.unwrap_err().to_string();
        assert!(error.contains("2 of 3 devices answered") && heard == [1, 3], "{error}");
    }

    #[test]
    fn a_line_works_as_long_as_any_device_answers() {
        let (mut line, once) = (RequestReply::half_duplex(false), Retry::once(Duration::ZERO));
        line.open(Line { silent: Some(2), ..Line::default() });
        for _ in 0..2 * LOST_AFTER {
            assert_eq!(line.gather_some(b"?", once, 3, device, |_| true), Ok(2));
        }
        for _ in 0..LOST_AFTER {
            let none = line.gather_some(b"!", once, 3, device, |_| true);
            assert!(matches!(none, Err(AdapterError::Timeout(_))), "{none:?}");
        }
        assert!(!line.is_open());
    }
}
