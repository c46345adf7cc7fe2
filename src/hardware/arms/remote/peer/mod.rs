//! A peer in Rust: serves any adapter over the protocol, for `address: sim`, tests and benchmarks, and as an example
//! for peers in other languages.
//!
//! One thread does it all: it waits for a client, a request or the end, and the adapter is called by nobody else.

mod service;
pub mod wire;

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::fs::FileTypeExt;
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use self::service::Service;
use super::Options;
use super::address::Address;
use crate::hardware::registry::{AdapterConfig, Emulator, Place, Registry};
use crate::hardware::sim::diary::{self, Happening};
use crate::hardware::sim::faults::{Fault, FaultKind, check_kind};
use crate::hardware::sim::tcp_server::cannot_listen;
use crate::hardware::spec::{AdapterError, AdapterResult, ManipulatorAdapter};
use crate::rt::host;
use crate::rt::wake::Wake;

/// Without a request for this long, a peer stops an arm that was commanded.
pub const SILENCE: Duration = Duration::from_millis(500);
/// The port of an emulator that is to listen on an address of its own.
pub const PORT: u16 = 7450;
/// Longest wait for a client that does not take its reply.
const SEND_TIMEOUT: Duration = Duration::from_secs(1);

/// The faults that a peer can play, whatever it serves.
pub(super) const PLAYABLE: &[FaultKind] = &[
    FaultKind::Stall,
    FaultKind::Silent,
    FaultKind::Disconnect,
    FaultKind::ErrorCode,
    FaultKind::Estop,
    FaultKind::Nan,
    FaultKind::WrongDof,
    FaultKind::Frozen,
];

/// A peer that serves an adapter until it is dropped.
pub struct Peer {
    address: Address,
    service: Arc<Mutex<Service>>,
    end: Arc<AtomicBool>,
    wake: Wake,
    thread: Option<JoinHandle<()>>,
}

impl Peer {
    /// Serves `adapter` at an address; a TCP port 0 is any free one.
    ///
    /// ```
    /// use dimos::hardware::arms::remote::{address::Address, peer::Peer};
    /// use dimos::hardware::registry;
    ///
    /// let any_port = Address::Tcp(([127, 0, 0, 1], 0).into());
    /// let peer = Peer::start(registry::create("mock", "", 6)?, &any_port)?;
    /// let mut arm = registry::create("remote", &peer.address().to_string(), 6)?;
    /// arm.connect()?;
    /// assert_eq!(arm.get_info().model, "mock");
    /// # Ok::<(), dimos::hardware::spec::AdapterError>(())
    /// ```
    pub fn start(adapter: Box<dyn ManipulatorAdapter>, address: &Address) -> AdapterResult<Self> {
        Self::serve(Service::new(adapter, None, &[]), address)
    }

    fn serve(service: Service, address: &Address) -> AdapterResult<Self> {
        let failed = |e| match address {
            Address::Tcp(at) => cannot_listen("peer", *at, &e),
            Address::Unix(_) => AdapterError::Io(format!("cannot listen at {address}: {e}")),
        };
        let listener = Listener::bind(address).map_err(failed)?;
        let address = listener.address(address).map_err(failed)?;
        let (service, wake) = (Arc::new(Mutex::new(service)), Wake::new().map_err(failed)?);
        let end = Arc::new(AtomicBool::new(false));
        let mut serving = Serving { service: service.clone(), end: end.clone(), wake: wake.clone(), client: None };
        let thread = std::thread::Builder::new()
            .name("remote-peer".into())
            .spawn(move || serving.run(&listener))
            .map_err(failed)?;
        Ok(Self { address, service, end, wake, thread: Some(thread) })
    }

    /// Where it listens.
    pub fn address(&self) -> &Address {
        &self.address
    }

    /// Lets a fault happen `fault.at` seconds from now; an error names the kinds that can be played.
    pub fn inject(&self, fault: Fault) -> Result<(), String> {
        check_kind("the peer", &fault, PLAYABLE)?;
        lock(&self.service).inject(fault);
        Ok(())
    }
}

/// The emulator of the table's row: the mock arm behind the protocol.
pub fn start_emulator(config: &AdapterConfig, place: &Place) -> AdapterResult<PeerEmulator> {
    config.fit(super::fit)?;
    let sim = config.options::<Options>()?.sim;
    let registry = Registry::builtin();
    let mock = registry.get("mock").ok_or(AdapterError::Unsupported)?;
    let options = serde_json::json!({ "initial_positions": sim.initial_positions, "effort_feedback": true });
    let arm = (mock.create)(&AdapterConfig { options, ..config.clone() })?;
    let service = Service::new(arm, Some(super::SPEC.holds_when_disabled), &sim.faults);
    Peer::serve(service, &Address::Tcp(place.tcp(PORT)?)).map(PeerEmulator)
}

/// A peer as the emulator of a remote arm.
pub struct PeerEmulator(Peer);

impl Emulator for PeerEmulator {
    fn address(&self) -> String {
        self.0.address().to_string()
    }

    fn inject(&self, fault: Fault) -> Result<(), String> {
        self.0.inject(fault)
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        self.end.store(true, Ordering::SeqCst);
        self.wake.raise();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
        if let Address::Unix(path) = &self.address {
            let _ = std::fs::remove_file(path);
        }
    }
}

fn lock(service: &Mutex<Service>) -> MutexGuard<'_, Service> {
    service.lock().unwrap_or_else(PoisonError::into_inner)
}

/// What can be listened on.
enum Listener {
    Unix(UnixListener),
    Tcp(TcpListener),
}

impl Listener {
    fn bind(address: &Address) -> std::io::Result<Self> {
        match address {
            Address::Unix(path) => {
                // The socket of a peer that is gone stands in the way; that of one that lives stays, and so do files.
                let is_socket = std::fs::symlink_metadata(path).is_ok_and(|found| found.file_type().is_socket());
                if is_socket && UnixStream::connect(path).is_err_and(|e| e.kind() == ErrorKind::ConnectionRefused) {
                    std::fs::remove_file(path)?;
                }
                let listener = UnixListener::bind(path)?;
                let owner_only = std::os::unix::fs::PermissionsExt::from_mode(0o600);
                std::fs::set_permissions(path, owner_only)?;
                listener.set_nonblocking(true)?;
                Ok(Self::Unix(listener))
            }
            Address::Tcp(address) => {
                let listener = TcpListener::bind(address)?;
                listener.set_nonblocking(true)?;
                Ok(Self::Tcp(listener))
            }
        }
    }

    fn address(&self, given: &Address) -> std::io::Result<Address> {
        Ok(match self {
            Self::Unix(_) => given.clone(),
            Self::Tcp(listener) => {
                Address::Tcp(SocketAddr::new(listener.local_addr()?.ip(), listener.local_addr()?.port()))
            }
        })
    }

    fn accept(&self) -> std::io::Result<Client> {
        match self {
            Self::Unix(listener) => {
                let (stream, _) = listener.accept()?;
                stream.set_nonblocking(false)?;
                stream.set_write_timeout(Some(SEND_TIMEOUT))?;
                Ok(Client { stream: Stream::Unix(stream), arrived: Vec::new(), heard: Instant::now() })
            }
            Self::Tcp(listener) => {
                let (stream, _) = listener.accept()?;
                stream.set_nonblocking(false)?;
                stream.set_write_timeout(Some(SEND_TIMEOUT))?;
                stream.set_nodelay(true)?;
                Ok(Client { stream: Stream::Tcp(stream), arrived: Vec::new(), heard: Instant::now() })
            }
        }
    }
}

impl AsFd for Listener {
    fn as_fd(&self) -> BorrowedFd<'_> {
        match self {
            Self::Unix(listener) => listener.as_fd(),
            Self::Tcp(listener) => listener.as_fd(),
        }
    }
}

enum Stream {
    Unix(UnixStream),
    Tcp(TcpStream),
}

/// The client that is served.
struct Client {
    stream: Stream,
    /// What has arrived and is not a whole request yet.
    arrived: Vec<u8>,
    /// When the last request was answered.
    heard: Instant,
}

impl Client {
    fn send(&mut self, reply: &[u8]) -> bool {
        match &mut self.stream {
            Stream::Unix(stream) => stream.write_all(reply).is_ok(),
            Stream::Tcp(stream) => stream.write_all(reply).is_ok(),
        }
    }

    /// Takes what has arrived; `false` at the end of the connection.
    fn receive(&mut self) -> bool {
        let mut buffer = [0; 4096];
        let n = match &mut self.stream {
            Stream::Unix(stream) => stream.read(&mut buffer),
            Stream::Tcp(stream) => stream.read(&mut buffer),
        };
        match n {
            Ok(n @ 1..) => {
                self.arrived.extend(buffer.iter().take(n));
                true
            }
            _ => false,
        }
    }
}

impl AsFd for Client {
    fn as_fd(&self) -> BorrowedFd<'_> {
        match &self.stream {
            Stream::Unix(stream) => stream.as_fd(),
            Stream::Tcp(stream) => stream.as_fd(),
        }
    }
}

/// The thread of a peer.
struct Serving {
    service: Arc<Mutex<Service>>,
    end: Arc<AtomicBool>,
    wake: Wake,
    client: Option<Client>,
}

impl Serving {
    fn run(&mut self, listener: &Listener) {
        host::enter_realtime(host::EMULATOR_PRIORITY);
        while !self.end.load(Ordering::SeqCst) {
            let (asked, knocked) = self.wait(listener);
            if asked && !self.serve() {
                self.hang_up();
            }
            // After the client, so that one that has just gone does not count as there.
            if knocked && let Ok(mut client) = listener.accept() {
                if self.client.is_none() {
                    self.client = Some(client);
                    diary::note(Happening::Came);
                } else {
                    let busy = AdapterError::Rejected("it serves another client already".to_owned());
                    client.send(&wire::refused(1, &busy));
                    diary::note(Happening::TurnedAway);
                }
            }
            self.watch_for_silence();
        }
        lock(&self.service).end();
    }

    /// Waits for something to do: what the client asks, or another client that knocks.
    fn wait(&self, listener: &Listener) -> (bool, bool) {
        let silence = self.client.as_ref().filter(|_| lock(&self.service).commanded());
        let time = silence.map_or(Duration::from_secs(1), |client| SILENCE.saturating_sub(client.heard.elapsed()));
        let time = time.max(Duration::from_millis(10));
        let time = Timespec { tv_sec: time.as_secs() as i64, tv_nsec: time.subsec_nanos() as i64 };
        let mut fds = [PollFd::new(&self.wake, PollFlags::IN), PollFd::new(listener, PollFlags::IN)].to_vec();
        fds.extend(self.client.as_ref().map(|client| PollFd::new(client, PollFlags::IN)));
        if poll(&mut fds, Some(&time)).is_err() {
            return (false, false);
        }
        let ready = |index: usize| fds.get(index).is_some_and(|fd: &PollFd<'_>| !fd.revents().is_empty());
        (ready(2), ready(1))
    }

    /// Answers what the client asks; `false` when it is gone or speaks something else.
    fn serve(&mut self) -> bool {
        let Some(client) = &mut self.client else { return true };
        if !client.receive() {
            return false;
        }
        loop {
            let request = match wire::take(&mut client.arrived) {
                Ok(Some(request)) => request,
                Ok(None) => return true,
                Err(what) => {
                    client.send(&wire::refused(0, &AdapterError::Protocol(what.to_owned())));
                    return false;
                }
            };
            let mut service = lock(&self.service);
            if service.strikes(FaultKind::Disconnect).is_some() {
                return false;
            }
            if let Some(time) = service.strikes(FaultKind::Stall) {
                drop(service);
                self.wake.wait(if time.is_zero() { Duration::from_secs(1) } else { time });
                service = lock(&self.service);
            }
            let silent = service.strikes(FaultKind::Silent).is_some();
            let answer = service.answer(&request);
            drop(service);
            let reply = match answer {
                Ok(content) => wire::done(request.id, content),
                Err(error) => wire::refused(request.id, &error),
            };
            if !silent && !client.send(&reply) {
                return false;
            }
            client.heard = Instant::now();
        }
    }

    fn hang_up(&mut self) {
        if self.client.take().is_some() {
            diary::note(Happening::Gone);
        }
        let mut service = lock(&self.service);
        if service.commanded() {
            service.stop_by_itself("its client has gone");
        }
    }

    /// A client that was commanding and has fallen silent may be stuck: the arm does not go on without it.
    fn watch_for_silence(&mut self) {
        let silent = self.client.as_ref().is_none_or(|client| client.heard.elapsed() >= SILENCE);
        let mut service = lock(&self.service);
        if silent && service.commanded() {
            service.stop_by_itself("no request came for 0.5 s: enable it again");
        }
    }
}
