//! The emulator's sockets and threads: one thread waits for clients and sends the reports when they are due, one more
//! per control connection answers requests.

use std::io::{Read, Write};
use std::net::{IpAddr, Shutdown, TcpListener, TcpStream};
use std::os::fd::AsFd;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::controller::{Controller, Delivery};
use super::report::Kind;
use super::wire;
use super::{Ports, Withhold};
use crate::clock::{Clock, Mono, MonotonicClock};
use crate::hardware::sim::diary::{self, Happening};
use crate::hardware::transport::tcp::Scan;
use crate::rt::host;
use crate::rt::wake::Wake;

/// What noise looks like: among it the beginning of a header.
const NOISE: &[u8] = b"\x00\xffnoise\x00\x02\x00\x00\x00\x00";
/// Most control connections at once.
const CLIENTS: usize = 16;

struct Shared {
    ip: IpAddr,
    control: u16,
    /// Whether there is a second control port, one above the first.
    second: bool,
    reports: u16,
    /// Whether there is a report at the first report port.
    full: bool,
    controller: Mutex<Controller>,
    line: Mutex<Line>,
    changed: Condvar,
    wake: Wake,
}

/// What the threads tell each other.
struct Line {
    /// The emulator ends.
    closing: bool,
    /// All connections are to end.
    cut: bool,
    /// Nothing is sent until then.
    stalled_until: Instant,
    /// Nobody is even listening until then.
    dark_until: Instant,
    /// The control connections.
    clients: Vec<TcpStream>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Shared {
    /// Waits until `when` of the line has come, or the emulator ends.
    fn wait(&self, when: impl Fn(&Line) -> Instant) {
        let mut line = lock(&self.line);
        while !line.closing {
            let left = when(&line).saturating_duration_since(Instant::now());
            if left.is_zero() {
                return;
            }
            line = self.changed.wait_timeout(line, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Ends all connections, and for so long nobody listens.
    fn cut(&self, dark: Duration) {
        let mut line = lock(&self.line);
        line.cut = true;
        line.dark_until = Instant::now() + dark;
        line.clients.iter().for_each(|client| drop(client.shutdown(Shutdown::Both)));
        line.clients.clear();
        drop(line);
        self.changed.notify_all();
        self.wake.raise();
    }

    /// Does to a packet, and to the connections, what a fault does. Whether what is left of the packet is to be sent.
    fn deliver(&self, delivery: Delivery, packet: &mut Vec<u8>) -> bool {
        match delivery {
            Delivery::Send | Delivery::Frozen => return true,
            Delivery::Silent => return false,
            Delivery::Stall(time) => {
                lock(&self.line).stalled_until = Instant::now() + time;
                self.wait(|line| line.stalled_until);
            }
            Delivery::Garbage => drop(packet.splice(0..0, NOISE.iter().copied())),
            Delivery::Corrupt => {
                // The highest byte of the first measured joint in a full report; the state byte of a response.
                let at = if packet.len() > 119 { 119 } else { packet.len().saturating_sub(1) };
                packet.get_mut(at).into_iter().for_each(|byte| *byte ^= 0x40);
            }
            Delivery::Truncated => packet.truncate(packet.len() / 2),
            Delivery::Disconnect => self.cut(Duration::ZERO),
            Delivery::PowerLoss(dark) => self.cut(dark),
        }
        !matches!(delivery, Delivery::Disconnect | Delivery::PowerLoss(_))
    }
}

/// A controller with its ports open.
pub struct Server {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

impl Server {
    /// Serves at these ports. `full`: the firmware has the report of the first report port.
    pub fn start(controller: Controller, ports: Ports, full: bool) -> std::io::Result<Self> {
        let first = ports.reports.first().map_or(Ok(0), |port| port.local_addr().map(|at| at.port()))?;
        let now = Instant::now();
        let shared = Arc::new(Shared {
            ip: ports.ip,
            control: ports.control.local_addr()?.port(),
            second: ports.second.is_some(),
            reports: first,
            full,
            controller: Mutex::new(controller),
            line: Mutex::new(Line {
                closing: false,
                cut: false,
                stalled_until: now,
                dark_until: now,
                clients: Vec::new(),
            }),
            changed: Condvar::new(),
            wake: Wake::new()?,
        });
        let for_thread = shared.clone();
        let thread = std::thread::Builder::new().name("xarm-sim".into()).spawn(move || {
            host::enter_realtime(host::EMULATOR_PRIORITY);
            Floor { shared: for_thread, sessions: Vec::new(), readers: Vec::new() }.run(ports);
        })?;
        Ok(Self { shared, thread: Some(thread) })
    }

    /// Where it is reached, with all its ports.
    pub fn address(&self) -> String {
        let Shared { ip, control, reports, .. } = &*self.shared;
        format!("{}:{reports}", std::net::SocketAddr::new(*ip, *control))
    }

    /// Does something with the controller, now.
    pub fn with<T>(&self, f: impl FnOnce(&mut Controller, Mono) -> T) -> T {
        f(&mut lock(&self.shared.controller), MonotonicClock.now())
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        lock(&self.shared.line).closing = true;
        self.shared.cut(Duration::ZERO);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// A client that reads reports.
struct Reader {
    kind: Kind,
    stream: TcpStream,
    due: Instant,
    last: Vec<u8>,
}

/// What the first thread works with.
struct Floor {
    shared: Arc<Shared>,
    sessions: Vec<JoinHandle<()>>,
    readers: Vec<Reader>,
}

impl Floor {
    fn run(mut self, ports: Ports) {
        let mut ports = Some(ports);
        loop {
            let line = lock(&self.shared.line);
            let (closing, dark) = (line.closing, line.dark_until > Instant::now());
            drop(line);
            if std::mem::take(&mut lock(&self.shared.line).cut) {
                self.readers.clear();
            }
            if closing {
                break;
            }
            if dark {
                ports = None;
                self.shared.wait(|line| line.dark_until);
                continue;
            }
            match &ports {
                Some(open) => {
                    self.look(open);
                    self.send_reports();
                }
                None => {
                    // After a loss of power, on the same ports.
                    ports =
                        Ports::at(self.shared.ip, self.shared.control, self.shared.reports, self.shared.second).ok();
                    if ports.is_none() {
                        std::thread::sleep(Duration::from_millis(20));
                    }
                }
            }
        }
        self.sessions.into_iter().for_each(|session| drop(session.join()));
    }

    /// Waits for clients until a report is due, and lets them in.
    fn look(&mut self, ports: &Ports) {
        let due = self.readers.iter().map(|reader| reader.due).min();
        let left = due.map_or(Duration::from_secs(1), |due| due.saturating_duration_since(Instant::now()));
        let timeout = Timespec { tv_sec: left.as_secs() as i64, tv_nsec: left.subsec_nanos().into() };
        let listeners = || ports.reports.iter().chain([&ports.control]).chain(&ports.second);
        let mut fds: Vec<_> = listeners().map(|l| PollFd::new(l, PollFlags::IN)).collect();
        fds.push(PollFd::from_borrowed_fd(self.shared.wake.as_fd(), PollFlags::IN));
        if !poll(&mut fds, Some(&timeout)).is_ok_and(|n| n > 0) {
            return;
        }
        let ready: Vec<bool> = fds.iter().map(|fd| !fd.revents().is_empty()).collect();
        if ready.last() == Some(&true) {
            self.shared.wake.lower();
        }
        for (i, (listener, _)) in listeners().zip(&ready).enumerate().filter(|(_, (_, ready))| **ready) {
            self.accept(listener, Kind::ALL.get(i).copied(), i > Kind::ALL.len());
        }
    }

    fn accept(&mut self, listener: &TcpListener, reports: Option<Kind>, second: bool) {
        let Ok((stream, _)) = listener.accept() else {
            std::thread::sleep(Duration::from_millis(10)); // out of descriptors, say: do not spin
            return;
        };
        let _ = stream.set_nodelay(true);
        match reports {
            Some(Kind::Full) if !self.shared.full || self.withheld() == Withhold::Close => {}
            Some(kind) if stream.set_nonblocking(true).is_ok() => {
                self.readers.push(Reader { kind, stream, due: Instant::now(), last: Vec::new() });
            }
            Some(_) => {}
            None => self.begin_session(stream, second),
        }
    }

    fn withheld(&self) -> Withhold {
        lock(&self.shared.controller).withhold
    }

    fn begin_session(&mut self, stream: TcpStream, second: bool) {
        self.sessions.retain(|session| !session.is_finished());
        let Ok(copy) = stream.try_clone() else { return };
        let mut line = lock(&self.shared.line);
        if line.closing || self.sessions.len() >= CLIENTS {
            diary::note(Happening::TurnedAway);
            return;
        }
        line.clients.push(copy);
        drop(line);
        let shared = self.shared.clone();
        let session = std::thread::Builder::new().name("xarm-sim-client".into()).spawn(move || {
            host::enter_realtime(host::EMULATOR_PRIORITY);
            let peer = stream.peer_addr().ok();
            diary::note(Happening::Came);
            serve(&shared, stream, second);
            diary::note(Happening::Gone);
            lock(&shared.line).clients.retain(|client| client.peer_addr().ok() != peer);
        });
        self.sessions.extend(session);
    }

    /// Sends what is due.
    fn send_reports(&mut self) {
        let now = Instant::now();
        let (mut packet, shared) = (Vec::with_capacity(1024), &self.shared);
        self.readers.retain_mut(|reader| {
            if reader.due > now {
                return true;
            }
            let period = Duration::from_micros(reader.kind.period_us());
            reader.due = if now > reader.due + period { now + period } else { reader.due + period };
            let mut controller = lock(&shared.controller);
            match reader.kind {
                Kind::Normal if controller.condition_muted => return true,
                Kind::Full if controller.withhold != Withhold::No => return controller.withhold == Withhold::Silence,
                _ => {}
            }
            let mono = MonotonicClock.now();
            let snapshot = controller.snapshot(mono);
            // Damage strikes where it matters: at the reports with the joints.
            let strikes = matches!(reader.kind, Kind::Full | Kind::Real);
            let delivery = if strikes { controller.delivery(mono) } else { controller.mute(mono) };
            drop(controller);
            reader.kind.write(&snapshot, &mut packet);
            if delivery == Delivery::Frozen && !reader.last.is_empty() {
                packet.clone_from(&reader.last);
            }
            reader.last.clone_from(&packet);
            if !shared.deliver(delivery, &mut packet) {
                return !matches!(delivery, Delivery::Disconnect | Delivery::PowerLoss(_));
            }
            // A client that does not read is dropped.
            reader.stream.write(&packet).is_ok_and(|written| written == packet.len())
        });
    }
}

/// Serves a control connection until it ends.
fn serve(shared: &Shared, mut stream: TcpStream, second: bool) {
    let mut buffer = [0; 4096];
    let mut filled = 0;
    let mut reply = Vec::with_capacity(256);
    while let Ok(n @ 1..) = stream.read(buffer.get_mut(filled..).unwrap_or_default()) {
        filled += n;
        let mut used = 0;
        loop {
            let bytes = buffer.get(used..filled).unwrap_or_default();
            let (length, request) = match wire::scan(bytes) {
                Scan::More => break,
                Scan::Skip(n) => (n, None),
                Scan::Take(n, ()) => (n, bytes.get(..n).and_then(wire::parts)),
            };
            used += length;
            let Some(request) = request else { continue };
            let mut controller = lock(&shared.controller);
            let delivery = controller.handle(&request, second, MonotonicClock.now(), &mut reply);
            let ready_at = Instant::now() + controller.reply_time(request.register);
            drop(controller);
            shared.wait(|_| ready_at);
            // A client that is gone gets no reply; what it had sent before still counts.
            if shared.deliver(delivery, &mut reply) {
                let _ = stream.write_all(&reply);
            }
        }
        buffer.copy_within(used..filled, 0);
        filled -= used;
    }
}
