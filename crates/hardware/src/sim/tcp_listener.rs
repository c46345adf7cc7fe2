//! The listening thread of a [`super::tcp_server::TcpServer`]: accepts clients and sends periodic reports.

use std::io::Write;
use std::net::{TcpListener, TcpStream};
use std::os::fd::AsFd;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::arm::Delivery;
use super::events::{self, SimEvent};
use super::stream::{Controller, Ending};
use super::tcp_server::{Inner, Port};
use dimos_core::sync::lock;

/// Time between two attempts to listen again after a loss of power.
const RETRY: Duration = Duration::from_millis(20);

/// State of the listening thread.
pub(super) struct ListenerThread<C> {
    inner: Arc<Inner<C>>,
    /// `None` while the controller has no power.
    listeners: Option<Vec<TcpListener>>,
    sessions: Vec<JoinHandle<()>>,
    readers: Vec<Reader>,
}

/// A client that reads reports.
struct Reader {
    port: usize,
    period: Duration,
    stream: TcpStream,
    due: Instant,
    /// The last report sent.
    last: Vec<u8>,
}

impl<C: Controller> ListenerThread<C> {
    pub fn new(inner: Arc<Inner<C>>, listeners: Vec<TcpListener>) -> Self {
        Self { inner, listeners: Some(listeners), sessions: Vec::new(), readers: Vec::new() }
    }

    /// Runs until the emulator ends.
    pub fn run(mut self) {
        let inner = self.inner.clone();
        loop {
            let line = lock(&inner.shared.line);
            let (closing, dark) = (line.closing, line.dark_until > Instant::now());
            drop(line);
            if inner.ended.swap(false, Ordering::AcqRel) {
                self.readers.clear();
            }
            if closing {
                break;
            }
            if dark {
                self.listeners = None;
                inner.shared.wait(|line| line.dark_until);
            } else if let Some(listeners) = self.listeners.take() {
                self.accept_clients(&listeners);
                self.listeners = Some(listeners);
                self.send_reports();
            } else {
                // On the same ports as before.
                self.listeners = inner.ports.iter().map(|(address, _)| TcpListener::bind(address).ok()).collect();
                if self.listeners.is_none() {
                    std::thread::sleep(RETRY);
                }
            }
        }
        self.sessions.into_iter().for_each(|session| drop(session.join()));
    }

    /// Accepts clients until a report is due.
    fn accept_clients(&mut self, listeners: &[TcpListener]) {
        let due = self.readers.iter().map(|reader| reader.due).min();
        let left = due.map_or(Duration::from_secs(1), |due| due.saturating_duration_since(Instant::now()));
        let timeout = Timespec { tv_sec: left.as_secs() as i64, tv_nsec: left.subsec_nanos().into() };
        let mut fds: Vec<_> = listeners.iter().map(|listener| PollFd::new(listener, PollFlags::IN)).collect();
        fds.push(PollFd::from_borrowed_fd(self.inner.wake.as_fd(), PollFlags::IN));
        if !poll(&mut fds, Some(&timeout)).is_ok_and(|n| n > 0) {
            return;
        }
        let ready: Vec<bool> = fds.iter().map(|fd| !fd.revents().is_empty()).collect();
        if ready.last() == Some(&true) {
            self.inner.wake.lower();
        }
        if lock(&self.inner.shared.line).dead() {
            return;
        }
        for (port, listener) in listeners.iter().enumerate().filter(|(port, _)| ready.get(*port) == Some(&true)) {
            match listener.accept() {
                Ok((stream, _)) => self.add_client(stream, port),
                Err(_) => std::thread::sleep(Duration::from_millis(10)), // for example, no descriptors left: do not spin
            }
        }
    }

    fn add_client(&mut self, stream: TcpStream, port: usize) {
        if !(self.inner.admit)(&stream) {
            return events::note(SimEvent::Foreign);
        }
        let _ = stream.set_nodelay(true);
        match self.inner.ports.get(port) {
            Some((_, Port::Requests | Port::Sessions(_))) => {
                self.sessions.retain(|session| !session.is_finished());
                let inner = self.inner.clone();
                let builder = std::thread::Builder::new().name(format!("{}-sim-client", inner.name));
                self.sessions.extend(builder.spawn(move || inner.attend(stream, port)));
            }
            Some((_, Port::Reports(period))) if stream.set_nonblocking(true).is_ok() => {
                self.readers.push(Reader { port, period: *period, stream, due: Instant::now(), last: Vec::new() });
            }
            _ => {}
        }
    }

    /// Sends the reports that are due.
    fn send_reports(&mut self) {
        let now = Instant::now();
        let (mut packet, inner) = (Vec::with_capacity(1024), &self.inner);
        self.readers.retain_mut(|reader| {
            if reader.due > now {
                return true;
            }
            let next = reader.due + reader.period;
            reader.due = if now > next { now + reader.period } else { next };
            packet.clear();
            let report = inner.shared.with(|controller, now| controller.report(reader.port, now, &mut packet));
            let Some(delivery) = report else { return false };
            if delivery == Delivery::Frozen && !reader.last.is_empty() {
                packet.clone_from(&reader.last);
            }
            reader.last.clone_from(&packet);
            match inner.shared.play(delivery, &mut packet) {
                // A client that does not read is dropped.
                Ok(true) => reader.stream.write(&packet).is_ok_and(|written| written == packet.len()),
                Ok(false) => true,
                Err(Ending::Closed) => false,
                Err(Ending::Cut(dark)) => {
                    inner.cut(dark);
                    false
                }
            }
        });
    }
}
