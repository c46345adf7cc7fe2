//! Emulated controllers on byte streams: requests, responses, and faults of the wire. The streams are TCP connections
//! ([`super::tcp_server`]) and serial lines ([`super::serial_server`]).

use std::io::{Read, Write};
use std::net::IpAddr;
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crate::sim::arm::Delivery;
use crate::transport::tcp::Scan;
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_core::sync::lock;

/// Line noise, with the beginning of a frame in it.
const NOISE: &[u8] = b"\x00\xffgarbage\x59";
/// Time until a pending request is served again.
const PENDING_PERIOD: Duration = Duration::from_micros(500);
/// Maximum number of bytes of an incomplete request.
const MAX_PENDING: usize = 32_768;

/// The controller's side of a byte stream.
pub trait Controller: Send + 'static {
    /// Processes the request at the front of the received bytes, if it is complete. Puts the response into the empty
    /// `answer`; returns the length of the request and how the response is delivered.
    fn serve(&mut self, bytes: &[u8], now: Mono, answer: &mut Vec<u8>) -> Scan<Delivery>;

    /// The client has disconnected.
    fn client_gone(&mut self, now: Mono);

    /// Puts a response to a rejected client's first request, which is at the front of `bytes`, into `answer`. Without a
    /// response the connection is only closed.
    fn turn_away(&self, _bytes: &[u8], _answer: &mut Vec<u8>) {}

    /// Damages a response or report as the faults `garbage`, `corrupt` and `truncated` do.
    fn damage(&self, delivery: Delivery, answer: &mut Vec<u8>) {
        // After the noise, the beginning of a response that never continues.
        let noise = [NOISE, answer.get(..2).unwrap_or_default()].concat();
        delivery.damage(answer, &noise, answer.len().saturating_sub(1));
    }

    /// As [`Controller::serve`], for a controller with several ports, counted from 0.
    fn serve_port(&mut self, _port: usize, bytes: &[u8], now: Mono, answer: &mut Vec<u8>) -> Scan<Delivery> {
        self.serve(bytes, now, answer)
    }

    /// As [`Controller::serve_port`], for a controller that keeps a state per connection. `client` is the number of the
    /// connection.
    fn serve_client(
        &mut self,
        port: usize,
        _client: u64,
        bytes: &[u8],
        now: Mono,
        answer: &mut Vec<u8>,
    ) -> Scan<Delivery> {
        self.serve_port(port, bytes, now, answer)
    }

    /// Puts the periodic report for clients of `port` into the empty `packet`; `None` closes the connection.
    fn report(&mut self, _port: usize, _now: Mono, _packet: &mut Vec<u8>) -> Option<Delivery> {
        None
    }

    /// A client of a port with sessions has connected from this address.
    fn session_from(&mut self, _port: usize, _client: u64, _address: IpAddr) {}

    /// A client has connected to a port with sessions. What is put into `greeting` is sent first.
    fn session_began(&mut self, _port: usize, _client: u64, _now: Mono, _greeting: &mut Vec<u8>) {}

    /// As [`Controller::report`], for one client of a port with sessions. Nothing is sent if `packet` stays empty.
    fn session_report(&mut self, _port: usize, _client: u64, _now: Mono, _packet: &mut Vec<u8>) -> Option<Delivery> {
        Some(Delivery::Send)
    }

    /// A client of a port with sessions has disconnected.
    fn session_ended(&mut self, _port: usize, _client: u64, now: Mono) {
        self.client_gone(now);
    }
}

/// State shared by the threads of a server.
pub(super) struct Shared<C, Client> {
    pub controller: Mutex<C>,
    pub line: Mutex<Line<Client>>,
    pub changed: Condvar,
}

/// State of the line.
pub(super) struct Line<Client> {
    /// Whether the emulator ends.
    pub closing: bool,
    /// Clients being served.
    pub clients: Vec<Client>,
    /// No client is served until then.
    pub stalled_until: Instant,
    /// The controller does not listen until then.
    pub dark_until: Instant,
}

impl<Client> Line<Client> {
    /// Returns whether nothing is served: the emulator ends, or the controller has no power.
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

    /// Calls `f` with the controller and the current time.
    pub fn with<T>(&self, f: impl FnOnce(&mut C, Mono) -> T) -> T {
        let mut controller = lock(&self.controller);
        f(&mut controller, MonotonicClock.now())
    }

    /// Waits until the time that `when` returns, or until the emulator ends.
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

    /// Answers requests on a stream of `port` until it ends.
    pub fn serve(&self, port: usize, stream: &mut (impl Read + Write)) -> Ending {
        let (mut arrived, mut answer) = (Vec::with_capacity(4096), Vec::with_capacity(1024));
        let mut buffer = [0; 4096];
        while let Ok(n @ 1..) = stream.read(&mut buffer) {
            arrived.extend_from_slice(buffer.get(..n).unwrap_or_default());
            if let Err(ending) = self.answer((port, 0), &mut arrived, &mut answer, stream) {
                return ending;
            }
        }
        Ending::Closed
    }

    /// Answers the requests that have arrived from a client of a port, and removes them.
    pub fn answer(
        &self,
        (port, client): (usize, u64),
        arrived: &mut Vec<u8>,
        answer: &mut Vec<u8>,
        stream: &mut impl Write,
    ) -> Result<(), Ending> {
        let mut used = 0;
        while let Some(bytes @ [_, ..]) = arrived.get(used..) {
            answer.clear();
            match self.with(|controller, now| controller.serve_client(port, client, bytes, now, answer)) {
                Scan::More => break,
                Scan::Skip(n) => used += n.max(1),
                Scan::Take(_, Delivery::Pending) => {
                    let due = Instant::now() + PENDING_PERIOD;
                    self.wait(|_| due);
                    if self.closing() {
                        return Err(Ending::Closed);
                    }
                }
                Scan::Take(n, delivery) => {
                    used += n.max(1);
                    // A client that is gone gets no response; its earlier requests still count.
                    if self.play(delivery, answer)? {
                        let _ = stream.write_all(answer);
                    }
                    if delivery == Delivery::HangUp {
                        return Err(Ending::Closed);
                    }
                }
            }
        }
        arrived.drain(..used.min(arrived.len()));
        if arrived.len() > MAX_PENDING { Err(Ending::Closed) } else { Ok(()) }
    }

    /// Applies faults to a response or report. Returns whether the rest of it is to be sent.
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
            Delivery::Send
            | Delivery::Pending
            | Delivery::HangUp
            | Delivery::Frozen
            | Delivery::BusOff
            | Delivery::NoBuffers(_) => {}
        }
        Ok(true)
    }
}

/// Why a client is no longer served.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Ending {
    /// The client or the controller closed the connection.
    Closed,
    /// A fault closes all connections, without power for this time.
    Cut(Duration),
}
