//! An emulated controller on a TCP port of this computer: it serves one client at a time.
//!
//! A thread waits for clients, another serves the one that is connected; both sleep in the kernel while nothing comes.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::arm::HasArm;
use super::diary::{self, Happening};
use super::faults::Fault;
use super::stream::{Controller, Ending, Shared, lock};
use crate::clock::Mono;
use crate::hardware::registry::Emulator;
use crate::hardware::spec::{AdapterError, AdapterResult};
use crate::joint::Joints;
use crate::rt::host;

/// How long a new client waits for the end of one that has just gone.
const GRACE: Duration = Duration::from_millis(200);

/// A listening controller. It ends when it is dropped.
pub struct TcpServer<C: Controller> {
    inner: Arc<Inner<C>>,
    thread: Option<JoinHandle<()>>,
}

struct Inner<C> {
    address: SocketAddr,
    shared: Shared<C, TcpStream>,
    refused: AtomicU64,
}

impl<C: Controller> TcpServer<C> {
    /// Listens at `address`, which should be a loopback address. `name` is the arm's, for messages.
    pub fn start(name: &str, controller: C, address: SocketAddr) -> AdapterResult<Self> {
        let failed = |e| cannot_listen(&format!("{name} emulator"), address, &e);
        let listener = TcpListener::bind(address).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let inner = Arc::new(Inner { address, shared: Shared::new(controller), refused: AtomicU64::new(0) });
        let for_thread = inner.clone();
        let builder = std::thread::Builder::new().name(format!("{name}-sim"));
        let thread = builder.spawn(move || listen(&for_thread, listener)).map_err(failed)?;
        Ok(Self { inner, thread: Some(thread) })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.inner.address
    }

    /// Does something with the controller, now.
    pub fn with<T>(&self, f: impl FnOnce(&mut C, Mono) -> T) -> T {
        self.inner.shared.with(f)
    }

    /// How many clients were turned away because another one was connected.
    pub fn refused(&self) -> u64 {
        self.inner.refused.load(Ordering::Relaxed)
    }
}

impl<C: Controller + HasArm> Emulator for TcpServer<C> {
    fn address(&self) -> String {
        self.inner.address.to_string()
    }

    fn inject(&self, fault: Fault) -> Result<(), String> {
        self.with(|controller, now| controller.arm().inject(fault, now))
    }

    fn true_positions(&self) -> Option<Joints> {
        Some(self.with(|controller, now| controller.arm().positions_at(now)))
    }
}

impl<C: Controller> Drop for TcpServer<C> {
    fn drop(&mut self) {
        let mut line = lock(&self.inner.shared.line);
        line.closing = true;
        if let Some(client) = &line.client {
            let _ = client.shutdown(Shutdown::Both);
        }
        drop(line);
        self.inner.shared.changed.notify_all();
        self.inner.wake();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl<C: Controller> Inner<C> {
    /// Waits a moment for the last client to be gone; `false` when it stays.
    fn wait_for_free(&self) -> bool {
        let shared = &self.shared;
        let line = lock(&shared.line);
        let result = shared.changed.wait_timeout_while(line, GRACE, |line| line.client.is_some() && !line.closing);
        result.unwrap_or_else(PoisonError::into_inner).0.client.is_none()
    }

    /// Makes the waiting thread look up.
    fn wake(&self) {
        drop(TcpStream::connect_timeout(&self.address, GRACE));
    }

    /// Listens again on the same port after a loss of power; `None` when the emulator ends.
    fn relisten(&self) -> Option<TcpListener> {
        while !self.shared.closing() {
            match TcpListener::bind(self.address) {
                Ok(listener) => return Some(listener),
                Err(_) => std::thread::sleep(Duration::from_millis(20)),
            }
        }
        None
    }

    /// Answers the first request of a client that cannot be served, and hangs up.
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

    /// Serves one client until it is gone.
    fn serve(&self, mut stream: TcpStream) {
        let _ = stream.set_nodelay(true);
        diary::note(Happening::Came);
        let ending = self.shared.serve(&mut stream);
        diary::note(Happening::Gone);
        if let Ending::Dark(time) = ending {
            lock(&self.shared.line).dark_until = Instant::now() + time;
        }
        let _ = stream.shutdown(Shutdown::Both);
        if matches!(ending, Ending::Dark(_)) {
            self.wake();
        }
        self.shared.with(|controller, now| controller.client_gone(now));
        lock(&self.shared.line).client = None;
        self.shared.changed.notify_all();
    }
}

/// Why `who` cannot have a port of this computer, and what to do.
pub fn cannot_listen(who: &str, at: SocketAddr, error: &io::Error) -> AdapterError {
    let hint = match error.kind() {
        ErrorKind::PermissionDenied => format!(
            "\nhint: allow it with `sysctl net.ipv4.ip_unprivileged_port_start={}` as root, or give the program \
             CAP_NET_BIND_SERVICE",
            at.port()
        ),
        ErrorKind::AddrInUse => "\nhint: take another address of this computer, like 127.0.0.5".to_owned(),
        _ => String::new(),
    };
    AdapterError::Io(format!("{who}: cannot listen at {at}: {error}{hint}"))
}

/// The thread that waits for clients.
fn listen<C: Controller>(inner: &Arc<Inner<C>>, mut listener: TcpListener) {
    let shared = &inner.shared;
    let mut session: Option<JoinHandle<()>> = None;
    while !shared.closing() {
        let accepted = listener.accept();
        if lock(&shared.line).dark_until > Instant::now() {
            drop((accepted, listener));
            shared.wait(|line| line.dark_until);
            match inner.relisten() {
                Some(again) => listener = again,
                None => break,
            }
            continue;
        }
        shared.wait(|line| line.stalled_until);
        let Ok((stream, _)) = accepted else {
            std::thread::sleep(Duration::from_millis(10)); // out of descriptors, say: do not spin
            continue;
        };
        if shared.closing() {
            break;
        }
        if !inner.wait_for_free() {
            inner.refused.fetch_add(1, Ordering::Relaxed);
            diary::note(Happening::TurnedAway);
            inner.turn_away(stream);
            continue;
        }
        if let Some(ended) = session.take() {
            let _ = ended.join();
        }
        let Ok(copy) = stream.try_clone() else { continue };
        let mut line = lock(&shared.line);
        if line.closing {
            break;
        }
        line.client = Some(copy);
        drop(line);
        let for_thread = inner.clone();
        let name = std::thread::current().name().map(|name| format!("{name}-client")).unwrap_or_default();
        let spawned = std::thread::Builder::new().name(name).spawn(move || {
            host::enter_realtime(host::EMULATOR_PRIORITY);
            for_thread.serve(stream);
        });
        match spawned {
            Ok(thread) => session = Some(thread),
            Err(_) => lock(&shared.line).client = None,
        }
    }
    if let Some(session) = session {
        let _ = session.join();
    }
}
