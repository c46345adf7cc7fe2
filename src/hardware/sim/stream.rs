//! Emulated controllers on a stream of bytes: requests in, answers out, and what faults leave of them. The streams
//! themselves are TCP connections ([`super::tcp_server`]) and serial lines ([`super::serial_server`]).

use std::io::{Read, Write};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::clock::{Clock, Mono, MonotonicClock};
use crate::hardware::sim::arm::Delivery;
use crate::hardware::transport::tcp::Scan;

/// The controller's side of a stream of bytes.
pub trait Controller: Send + 'static {
    /// Looks at the front of what has arrived. Where a request stands there: does what it asks, puts the answer into
    /// `answer` (which is empty), and says how many bytes the request took and how the answer is delivered.
    fn serve(&mut self, bytes: &[u8], now: Mono, answer: &mut Vec<u8>) -> Scan<Delivery>;

    /// The client is gone.
    fn client_gone(&mut self, now: Mono);

    /// What a second client hears: puts an answer to its first request at the front of `bytes` into `answer`. Without
    /// an answer it is only hung up on.
    fn turn_away(&self, _bytes: &[u8], _answer: &mut Vec<u8>) {}
}

/// What the threads of a server share.
pub(super) struct Shared<C, Client> {
    pub controller: Mutex<C>,
    pub line: Mutex<Line<Client>>,
    pub changed: Condvar,
}

/// The state of the line.
pub(super) struct Line<Client> {
    /// The emulator ends.
    pub closing: bool,
    /// The client being served.
    pub client: Option<Client>,
    /// Nobody is served until then.
    pub stalled_until: Instant,
    /// Nobody is even listening until then.
    pub dark_until: Instant,
}

pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl<C: Controller, Client> Shared<C, Client> {
    pub fn new(controller: C) -> Self {
        let now = Instant::now();
        let line = Line { closing: false, client: None, stalled_until: now, dark_until: now };
        Self { controller: Mutex::new(controller), line: Mutex::new(line), changed: Condvar::new() }
    }

    pub fn closing(&self) -> bool {
        lock(&self.line).closing
    }

    /// Does something with the controller, now.
    pub fn with<T>(&self, f: impl FnOnce(&mut C, Mono) -> T) -> T {
        let mut controller = lock(&self.controller);
        f(&mut controller, MonotonicClock.now())
    }

    /// Waits until `when` of the line has come, or the emulator ends.
    pub fn wait(&self, when: impl Fn(&Line<Client>) -> Instant) {
        let mut line = lock(&self.line);
        while !line.closing {
            let left = when(&line).saturating_duration_since(Instant::now());
            if left.is_zero() {
                return;
            }
            line = self.changed.wait_timeout(line, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Answers what arrives on a stream until it ends.
    pub fn serve(&self, stream: &mut (impl Read + Write)) -> Ending {
        let mut buffer = [0; 1024];
        let mut filled = 0;
        let mut answer = Vec::with_capacity(512);
        while let Ok(n @ 1..) = stream.read(buffer.get_mut(filled..).unwrap_or_default()) {
            filled += n;
            let mut used = 0;
            while used < filled {
                answer.clear();
                let bytes = buffer.get(used..filled).unwrap_or_default();
                match self.with(|controller, now| controller.serve(bytes, now, &mut answer)) {
                    Scan::More => break,
                    Scan::Skip(n) => used += n.max(1),
                    Scan::Take(n, delivery) => {
                        used += n.max(1);
                        if let Err(ending) = self.deliver(stream, delivery, &mut answer) {
                            return ending;
                        }
                    }
                }
            }
            used = used.min(filled);
            buffer.copy_within(used..filled, 0);
            filled -= used;
        }
        Ending::Closed
    }

    /// Sends an answer, or what a fault leaves of it.
    fn deliver(&self, stream: &mut impl Write, delivery: Delivery, answer: &mut [u8]) -> Result<(), Ending> {
        let mut send = |bytes: &[u8]| stream.write_all(bytes).map_err(|_| Ending::Closed);
        match delivery {
            Delivery::Send => {}
            Delivery::Silent => return Ok(()),
            Delivery::Stall(time) => {
                lock(&self.line).stalled_until = Instant::now() + time;
                self.wait(|line| line.stalled_until);
            }
            Delivery::Garbage => {
                // Noise, and the beginning of an answer that never goes on.
                send(b"\x00\xffgarbage\x59")?;
                send(answer.get(..answer.len().min(2)).unwrap_or_default())?;
            }
            Delivery::Corrupt => {
                if let Some(byte) = answer.last_mut() {
                    *byte ^= 0x40;
                }
            }
            Delivery::Truncated => return send(answer.get(..answer.len() / 2).unwrap_or_default()),
            Delivery::Disconnect => return Err(Ending::Cut),
            Delivery::PowerLoss(time) => return Err(Ending::Dark(time)),
        }
        send(answer)
    }
}

/// Why serving a client ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Ending {
    /// The client hung up.
    Closed,
    /// A fault cuts the connection.
    Cut,
    /// A fault takes the power for so long.
    Dark(Duration),
}
