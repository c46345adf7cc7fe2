//! The emulator's sockets and threads.

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::controller::{Controller, Delivery};
use super::wire::{self, status};
use crate::clock::{Clock, Mono, MonotonicClock};
use crate::hardware::transport::tcp::Scan;
use crate::rt::host;

/// How long a new client waits for the end of one that has just gone.
const GRACE: Duration = Duration::from_millis(200);

struct Shared {
    address: SocketAddr,
    controller: Mutex<Controller>,
    line: Mutex<Line>,
    changed: Condvar,
    refused: AtomicU64,
}

/// What the threads tell each other.
struct Line {
    /// The emulator ends.
    closing: bool,
    /// The client being served.
    client: Option<TcpStream>,
    /// Nobody is served until then.
    stalled_until: Instant,
    /// Nobody is even listening until then.
    dark_until: Instant,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Shared {
    fn closing(&self) -> bool {
        lock(&self.line).closing
    }

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

    /// Waits a moment for the last client to be gone; `false` when it stays.
    fn wait_for_free(&self) -> bool {
        let busy = |line: &mut Line| line.client.is_some() && !line.closing;
        let result = self.changed.wait_timeout_while(lock(&self.line), GRACE, busy);
        result.unwrap_or_else(PoisonError::into_inner).0.client.is_none()
    }

    /// Makes the waiting thread look up.
    fn wake(&self) {
        drop(TcpStream::connect_timeout(&self.address, GRACE));
    }
}

/// A listening controller.
pub struct Server {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

impl Server {
    /// Listens at `address`.
    pub fn start(controller: Controller, address: SocketAddr) -> std::io::Result<Self> {
        let listener = TcpListener::bind(address)?;
        let now = Instant::now();
        let shared = Arc::new(Shared {
            address: listener.local_addr()?,
            controller: Mutex::new(controller),
            line: Mutex::new(Line { closing: false, client: None, stalled_until: now, dark_until: now }),
            changed: Condvar::new(),
            refused: AtomicU64::new(0),
        });
        let for_thread = shared.clone();
        let builder = std::thread::Builder::new().name("yourarm-sim".into());
        let thread = builder.spawn(move || listen(&for_thread, listener))?;
        Ok(Self { shared, thread: Some(thread) })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.shared.address
    }

    /// Does something with the controller, now.
    pub fn with<T>(&self, f: impl FnOnce(&mut Controller, Mono) -> T) -> T {
        f(&mut lock(&self.shared.controller), MonotonicClock.now())
    }

    /// How many clients were turned away.
    pub fn refused(&self) -> u64 {
        self.shared.refused.load(Ordering::Relaxed)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let mut line = lock(&self.shared.line);
        line.closing = true;
        if let Some(client) = &line.client {
            let _ = client.shutdown(Shutdown::Both);
        }
        drop(line);
        self.shared.changed.notify_all();
        self.shared.wake();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// The thread that waits for clients.
fn listen(shared: &Arc<Shared>, mut listener: TcpListener) {
    let mut session: Option<JoinHandle<()>> = None;
    while !shared.closing() {
        let accepted = listener.accept();
        if lock(&shared.line).dark_until > Instant::now() {
            drop((accepted, listener));
            shared.wait(|line| line.dark_until);
            match relisten(shared) {
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
        if !shared.wait_for_free() {
            shared.refused.fetch_add(1, Ordering::Relaxed);
            turn_away(stream);
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
        let for_thread = shared.clone();
        let spawned = std::thread::Builder::new().name("yourarm-sim-client".into()).spawn(move || {
            host::enter_realtime(host::EMULATOR_PRIORITY);
            serve(&for_thread, stream);
            lock(&for_thread.controller).client_gone(MonotonicClock.now());
            lock(&for_thread.line).client = None;
            for_thread.changed.notify_all();
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

/// Listens again on the same port after a loss of power; `None` when the emulator ends.
fn relisten(shared: &Shared) -> Option<TcpListener> {
    while !shared.closing() {
        match TcpListener::bind(shared.address) {
            Ok(listener) => return Some(listener),
            Err(_) => std::thread::sleep(Duration::from_millis(20)),
        }
    }
    None
}

/// Answers the first request of a client that cannot be served, and hangs up.
fn turn_away(mut stream: TcpStream) {
    let _ = stream.set_read_timeout(Some(GRACE));
    let mut buffer = [0; 512];
    let arrived = stream.read(&mut buffer).unwrap_or_default();
    if let Scan::Take(_, frame) = wire::scan(buffer.get(..arrived).unwrap_or_default()) {
        let mut reply = Vec::new();
        wire::reply(&mut reply, &frame, status::BUSY, |out| out.extend([0, 0]));
        let _ = stream.write_all(&reply);
    }
}

/// Serves a client until it is gone.
fn serve(shared: &Shared, mut stream: TcpStream) {
    let _ = stream.set_nodelay(true);
    let mut buffer = [0; 1024];
    let mut filled = 0;
    let mut reply = Vec::with_capacity(256);
    while let Ok(n @ 1..) = stream.read(buffer.get_mut(filled..).unwrap_or_default()) {
        filled += n;
        let mut used = 0;
        loop {
            match wire::scan(buffer.get(used..filled).unwrap_or_default()) {
                Scan::More => break,
                Scan::Skip(n) => used += n,
                Scan::Take(n, frame) => {
                    used += n;
                    let delivery = lock(&shared.controller).handle(&frame, MonotonicClock.now(), &mut reply);
                    if !deliver(shared, &mut stream, delivery, &mut reply) {
                        return;
                    }
                }
            }
        }
        buffer.copy_within(used..filled, 0);
        filled -= used;
    }
}

/// Sends a reply, or what a fault leaves of it; `false` when the connection has ended.
fn deliver(shared: &Shared, stream: &mut TcpStream, delivery: Delivery, reply: &mut [u8]) -> bool {
    match delivery {
        Delivery::Send => {}
        Delivery::Silent => return true,
        Delivery::Stall(time) => {
            lock(&shared.line).stalled_until = Instant::now() + time;
            shared.wait(|line| line.stalled_until);
        }
        Delivery::Garbage => {
            if stream.write_all(b"\x00\xff\x59YA\x01\x86garbage\x59").is_err() {
                return false;
            }
        }
        Delivery::Corrupt => {
            if let Some(byte) = reply.last_mut() {
                *byte ^= 0x40;
            }
        }
        Delivery::Truncated => return stream.write_all(reply.get(..reply.len() / 2).unwrap_or_default()).is_ok(),
        Delivery::Disconnect => {
            let _ = stream.shutdown(Shutdown::Both);
            return false;
        }
        Delivery::PowerLoss(time) => {
            lock(&shared.line).dark_until = Instant::now() + time;
            let _ = stream.shutdown(Shutdown::Both);
            shared.wake();
            return false;
        }
    }
    stream.write_all(reply).is_ok()
}
