//! Emulated controllers on streams of bytes: requests in, answers out, and what faults leave of them. The streams
//! themselves are TCP connections ([`super::tcp_server`]) and serial lines ([`super::serial_server`]).

use std::io::{Read, Write};
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crate::clock::{Clock, Mono, MonotonicClock};
use crate::hardware::sim::arm::Delivery;
use crate::hardware::transport::tcp::Scan;
use crate::sync::lock;

/// Noise on a line: among it the beginning of a frame.
const NOISE: &[u8] = b"\x00\xffgarbage\x59";
/// Most bytes that may wait for the rest of their request.
const MAX_PENDING: usize = 32_768;

/// The controller's side of a stream of bytes.
pub trait Controller: Send + 'static {
    /// Looks at the front of what has arrived. Where a request stands there: does what it asks, puts the answer into
    /// `answer` (which is empty), and says how many bytes the request took and how the answer is delivered.
    fn serve(&mut self, bytes: &[u8], now: Mono, answer: &mut Vec<u8>) -> Scan<Delivery>;

    /// The client is gone.
    fn client_gone(&mut self, now: Mono);

    /// What a client hears that is one too many: puts an answer to its first request at the front of `bytes` into
    /// `answer`. Without an answer the connection is only closed.
    fn turn_away(&self, _bytes: &[u8], _answer: &mut Vec<u8>) {}

    /// What the faults `garbage`, `corrupt` and `truncated` do to an answer or report.
    fn damage(&self, delivery: Delivery, answer: &mut Vec<u8>) {
        // Behind the noise, the beginning of an answer that never goes on.
        let noise = [NOISE, answer.get(..2).unwrap_or_default()].concat();
        delivery.damage(answer, &noise, answer.len().saturating_sub(1));
    }

    /// [`Controller::serve`] for a controller with several ports, which count from 0.
    fn serve_port(&mut self, _port: usize, bytes: &[u8], now: Mono, answer: &mut Vec<u8>) -> Scan<Delivery> {
        self.serve(bytes, now, answer)
    }

    /// Puts what the controller sends by itself over a connection to `port` into `packet` (which is empty), once a
    /// period; `None` ends the connection.
    fn report(&mut self, _port: usize, _now: Mono, _packet: &mut Vec<u8>) -> Option<Delivery> {
        None
    }
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
    /// The clients being served.
    pub clients: Vec<Client>,
    /// No client is served until then.
    pub stalled_until: Instant,
    /// The controller does not even listen until then.
    pub dark_until: Instant,
}

impl<Client> Line<Client> {
    /// Nothing is served: the emulator ends, or the controller has no power.
    pub fn dead(&self) -> bool {
        self.closing || self.dark_until > Instant::now()
    }
}

impl<C: Controller, Client> Shared<C, Client> {
    pub fn new(controller: C) -> Self {
        let now = Instant::now();
        let line = Line { closing: false, clients: Vec::new(), stalled_until: now, dark_until: now };
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

    /// Answers what arrives on a stream to `port` until it ends.
    pub fn serve(&self, port: usize, stream: &mut (impl Read + Write)) -> Ending {
        let (mut arrived, mut answer) = (Vec::with_capacity(4096), Vec::with_capacity(1024));
        let mut buffer = [0; 4096];
        while let Ok(n @ 1..) = stream.read(&mut buffer) {
            arrived.extend_from_slice(buffer.get(..n).unwrap_or_default());
            let mut used = 0;
            while let Some(bytes @ [_, ..]) = arrived.get(used..) {
                answer.clear();
                match self.with(|controller, now| controller.serve_port(port, bytes, now, &mut answer)) {
                    Scan::More => break,
                    Scan::Skip(n) => used += n.max(1),
                    Scan::Take(n, delivery) => {
                        used += n.max(1);
                        match self.play(delivery, &mut answer) {
                            // A client that is gone gets no answer; what it had sent before still counts.
                            Ok(true) => drop(stream.write_all(&answer)),
                            Ok(false) => {}
                            Err(ending) => return ending,
                        }
                        if delivery == Delivery::HangUp {
                            return Ending::Closed;
                        }
                    }
                }
            }
            arrived.drain(..used.min(arrived.len()));
            if arrived.len() > MAX_PENDING {
                break;
            }
        }
        Ending::Closed
    }

    /// Lets a fault strike at an answer or report: whether what is left of it is to be sent.
    pub fn play(&self, delivery: Delivery, answer: &mut Vec<u8>) -> Result<bool, Ending> {
        match delivery {
            Delivery::Silent => return Ok(false),
            Delivery::Late(time) => {
                let due = Instant::now() + time;
                self.wait(|_| due);
            }
            Delivery::Stall(time) => {
                lock(&self.line).stalled_until = Instant::now() + time;
                self.wait(|line| line.stalled_until);
            }
            Delivery::Garbage | Delivery::Corrupt | Delivery::Truncated => {
                lock(&self.controller).damage(delivery, answer);
            }
            Delivery::Disconnect(_) => return Err(Ending::Cut(Duration::ZERO)),
            Delivery::PowerLoss(time) => return Err(Ending::Cut(time)),
            Delivery::Send | Delivery::HangUp | Delivery::Frozen | Delivery::BusOff | Delivery::NoBuffers(_) => {}
        }
        Ok(true)
    }
}

/// Why serving a client ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Ending {
    /// The client, or the controller, hung up.
    Closed,
    /// A fault ends all connections, and takes the power for this long.
    Cut(Duration),
}
