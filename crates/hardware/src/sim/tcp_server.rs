//! An emulated controller on TCP ports of this computer: ports for requests, ports on which it sends periodic reports,
//! and ports for both.
//!
//! ```text
//!  listening thread ── accepts clients, sends reports, listens again after a loss of power
//!   └─▶ one thread per client with requests: reads, calls the controller, responds, sends a session's reports
//! ```
//!
//! All threads block in the kernel while nothing happens.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{IpAddr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::arm::HasArm;
use super::events::{self, SimEvent};
use super::faults::Fault;
use super::stream::{Controller, Ending, Line, Shared};
use super::tcp_listener::ListenerThread;
use crate::adapter::{AdapterError, AdapterResult};
use crate::registry::{Emulator, EmulatorAddress, Truth};
use dimos_core::clock::Mono;
use dimos_core::sync::lock;
use dimos_rt::host;
use dimos_rt::wake::Wake;

/// How long a new client waits for the end of one that is disconnecting.
const GRACE: Duration = Duration::from_millis(200);

/// Attempts to find consecutive free ports.
pub const ATTEMPTS: u32 = 200;

/// Purpose of a port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Port {
    /// Clients send requests; each gets a response.
    Requests,
    /// The controller sends a report to every client, with this period.
    Reports(Duration),
    /// Both at once, with a state per connection: requests, and reports with this period.
    Sessions(Duration),
}

impl Port {
    /// Returns the period of a port with sessions.
    fn session(self) -> Option<Duration> {
        if let Self::Sessions(period) = self { Some(period) } else { None }
    }
}

/// A running emulator on TCP. It ends when it is dropped.
pub struct TcpServer<C: Controller> {
    inner: Arc<Inner<C>>,
    thread: Option<JoinHandle<()>>,
}

/// State shared by the threads.
pub(super) struct Inner<C> {
    /// Name of the arm, for the names of threads.
    pub name: String,
    pub ports: Vec<(SocketAddr, Port)>,
    /// Maximum number of clients that send requests.
    max_clients: usize,
    /// Returns whether a new client is served.
    pub admit: Admit,
    pub shared: Shared<C, Client>,
    /// All connections were closed, including those of report readers.
    pub ended: AtomicBool,
    pub wake: Wake,
    next_client: AtomicU64,
    refused: AtomicU64,
}

/// Decides on a new client before anything is read from it.
pub type Admit = fn(&TcpStream) -> bool;

/// A client with requests: its number and its connection.
type Client = (u64, TcpStream);

impl<C: Controller> TcpServer<C> {
    /// Listens at `address`, which should be a loopback address, and serves one client at a time. `name` is for
    /// messages.
    pub fn start(name: &str, controller: C, address: SocketAddr) -> AdapterResult<Self> {
        let failed = |e| cannot_listen(&format!("{name} emulator"), address, &e);
        let listener = TcpListener::bind(address).map_err(failed)?;
        Self::with_ports(name, controller, vec![(listener, Port::Requests)], 1, |_| true).map_err(failed)
    }

    /// Serves several ports, and at most `max_clients` clients with requests at a time. Ports are numbered in this
    /// order. Clients that `admit` refuses are disconnected.
    pub fn with_ports(
        name: &str,
        controller: C,
        ports: Vec<(TcpListener, Port)>,
        max_clients: usize,
        admit: Admit,
    ) -> io::Result<Self> {
        let addresses = ports.iter().map(|(listener, port)| Ok((listener.local_addr()?, *port)));
        let inner = Arc::new(Inner {
            name: name.to_owned(),
            ports: addresses.collect::<io::Result<_>>()?,
            max_clients,
            admit,
            shared: Shared::new(controller),
            ended: AtomicBool::new(false),
            wake: Wake::new()?,
            next_client: AtomicU64::new(0),
            refused: AtomicU64::new(0),
        });
        let listening = ListenerThread::new(inner.clone(), ports.into_iter().map(|(listener, _)| listener).collect());
        let builder = std::thread::Builder::new().name(format!("{name}-sim"));
        let thread = builder.spawn(move || {
            host::enter_realtime(host::EMULATOR_PRIORITY);
            listening.run();
        })?;
        Ok(Self { inner, thread: Some(thread) })
    }

    /// Returns the address of the first port.
    pub fn address(&self) -> SocketAddr {
        self.inner.ports.first().map_or(SocketAddr::from(([0; 4], 0)), |(address, _)| *address)
    }

    /// Calls `f` with the controller and the current time.
    pub fn with<T>(&self, f: impl FnOnce(&mut C, Mono) -> T) -> T {
        self.inner.shared.with(f)
    }

    /// Returns how many clients were rejected because others were connected.
    pub fn refused(&self) -> u64 {
        self.inner.refused.load(Ordering::Relaxed)
    }
}

impl<C: Controller + HasArm> Emulator for TcpServer<C> {
    fn address(&self) -> String {
        Self::address(self).to_string()
    }

    fn inject(&self, fault: Fault) -> Result<(), String> {
        self.with(|controller, now| {
            let now = controller.time(now);
            controller.arm().inject(fault, now)
        })
    }

    fn truth(&self) -> Truth {
        self.with(|controller, now| controller.truth(now))
    }
}

impl<C: Controller> Drop for TcpServer<C> {
    fn drop(&mut self) {
        lock(&self.inner.shared.line).closing = true;
        self.inner.cut(Duration::ZERO);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl<C: Controller> Inner<C> {
    /// Closes all connections, and stops listening for `dark`.
    pub fn cut(&self, dark: Duration) {
        let mut line = lock(&self.shared.line);
        self.ended.store(true, Ordering::Release);
        line.dark_until = Instant::now() + dark;
        line.clients.iter().for_each(|(_, client)| drop(client.shutdown(Shutdown::Both)));
        drop(line);
        self.shared.changed.notify_all();
        self.wake.raise();
    }

    /// Serves a client with requests until it disconnects, unless there are too many clients.
    pub fn attend(&self, mut stream: TcpStream, port: usize) {
        host::enter_realtime(host::EMULATOR_PRIORITY);
        self.shared.wait(|line| line.stalled_until);
        let Some(number) = self.register(&stream) else {
            self.refused.fetch_add(1, Ordering::Relaxed);
            events::note(SimEvent::Rejected);
            return self.turn_away(stream);
        };
        events::note(SimEvent::Connected);
        let session = self.ports.get(port).and_then(|(_, kind)| kind.session());
        if let Some(address) = stream.peer_addr().ok().filter(|_| session.is_some()) {
            self.shared.with(|controller, _| controller.session_from(port, number, address.ip()));
        }
        let ending = match session {
            Some(period) => self.shared.converse((port, number), &mut stream, period),
            None => self.shared.serve(port, &mut stream),
        };
        events::note(SimEvent::Disconnected);
        if let Ending::Cut(dark) = ending {
            self.cut(dark);
        }
        let _ = stream.shutdown(Shutdown::Both);
        self.shared.with(|controller, now| match session {
            Some(_) => controller.session_ended(port, number, now),
            None => controller.client_gone(now),
        });
        lock(&self.shared.line).clients.retain(|(client, _)| *client != number);
        self.shared.changed.notify_all();
    }

    /// Waits up to [`GRACE`] for another client to disconnect; `None` if none does.
    fn register(&self, stream: &TcpStream) -> Option<u64> {
        let copy = stream.try_clone().ok()?;
        let line = lock(&self.shared.line);
        let full = |line: &mut Line<Client>| line.clients.len() >= self.max_clients && !line.closing;
        let waited = self.shared.changed.wait_timeout_while(line, GRACE, full);
        let mut line = waited.unwrap_or_else(PoisonError::into_inner).0;
        if line.clients.len() >= self.max_clients || line.dead() {
            return None;
        }
        let number = self.next_client.fetch_add(1, Ordering::Relaxed);
        line.clients.push((number, copy));
        Some(number)
    }

    /// Answers the first request of a rejected client, and closes the connection.
    fn turn_away(&self, mut stream: TcpStream) {
        let _ = stream.set_read_timeout(Some(GRACE));
        let mut buffer = [0; 512];
        let arrived = stream.read(&mut buffer).unwrap_or_default();
        let mut answer = Vec::new();
        self.shared.with(|controller, _| {
            controller.turn_away(buffer.get(..arrived).unwrap_or_default(), &mut answer);
        });
        let _ = stream.write_all(&answer);
    }
}

/// Listens at `count` consecutive ports from `first`; from any free port if that is 0.
pub fn ports_in_a_row(ip: IpAddr, first: u16, count: u16) -> io::Result<Vec<TcpListener>> {
    let listener = TcpListener::bind((ip, first))?;
    let first = listener.local_addr()?.port();
    let mut all = vec![listener];
    for offset in 1..count {
        let port = first.checked_add(offset).ok_or(ErrorKind::AddrNotAvailable)?;
        all.push(TcpListener::bind((ip, port))?);
    }
    Ok(all)
}

/// Listens at the consecutive ports of an emulator of `who`: `count` from `first` on, or from any free one in this
/// process. Returns the address of the first one, too.
pub fn emulator_ports(
    who: &str,
    place: &EmulatorAddress,
    first: u16,
    count: u16,
) -> AdapterResult<(SocketAddr, Vec<TcpListener>)> {
    let at = place.tcp(first)?;
    let who = format!("{who} emulator");
    let all = match at.port() {
        0 => (0..ATTEMPTS)
            .find_map(|_| ports_in_a_row(at.ip(), 0, count).ok())
            .ok_or_else(|| AdapterError::Io(format!("{who}: no {count} consecutive free ports at {}", at.ip())))?,
        _ => ports_in_a_row(at.ip(), first, count).map_err(|e| cannot_listen(&who, at, &e))?,
    };
    let listening = all.first().and_then(|listener| listener.local_addr().ok());
    Ok((listening.unwrap_or(at), all))
}

/// Returns why `who` cannot listen at a port, with a hint.
pub fn cannot_listen(who: &str, at: SocketAddr, error: &io::Error) -> AdapterError {
    let hint = match error.kind() {
        ErrorKind::PermissionDenied => format!(
            "\nhint: allow it with `sysctl net.ipv4.ip_unprivileged_port_start={}` as root, or give the program \
             CAP_NET_BIND_SERVICE",
            at.port()
        ),
        ErrorKind::AddrInUse => "\nhint: use another loopback address, like 127.0.0.5".to_owned(),
        _ => String::new(),
    };
    AdapterError::Io(format!("{who}: cannot listen at {at}: {error}{hint}"))
}
