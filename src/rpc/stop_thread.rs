//! The thread `rpc-stop`: accepts connections and answers the requests that always get through. If it hangs, another
//! one takes its place.
//!
//! ```text
//! new connection ─▶ at most 256 that have sent no line yet ─ stop, cancel, shutdown ─▶ answered without a permit
//!                                                          └ all else ─▶ permit ─▶ `urgent::serve`
//! ```

use std::collections::{BTreeMap, VecDeque};
use std::io;
use std::os::unix::net::{UnixListener as StdListener, UnixStream as StdStream};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use tokio::net::{UnixListener, UnixStream};
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};
use tokio::sync::{Semaphore, oneshot, watch};

use super::api::Backend;
use super::connection_limit::ConnectionLimit;
use super::error::{Code, RpcError};
use super::lease::Leases;
use super::mark::{Way, is_owner_or_root};
use super::run_dir::RunFiles;
use super::server::{refuse, runtime, until_the_end};
use super::urgent::{self, Transfer};
use crate::sync::lock;

/// Period of the thread's heartbeat, and of [`StopThread::check`].
pub(super) const BEAT_PERIOD: Duration = Duration::from_millis(100);
/// Consecutive checks without a heartbeat after which the thread hangs. Counted, not timed: where the whole process was
/// stopped, no thread hangs.
const MAX_MISSED_BEATS: u32 = 5;
/// Maximum number of hung threads that are replaced.
const MAX_HUNG: u32 = 3;
/// Maximum number of connections that have no permit yet, and of urgent requests that are answered without one.
const MAX_WITHOUT_PERMIT: usize = 256;
/// Period of the look at the socket's path: a socket that was removed is open again within 1 s.
const LOOK_PERIOD: Duration = Duration::from_millis(250);
/// Pause after a failed accept (no file descriptors left).
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// Poll period of the thread's end.
const POLL_PERIOD: Duration = Duration::from_millis(10);

/// What the threads of a server share, also one that hangs and its replacement.
pub(super) struct Reception {
    /// The open socket.
    listener: Mutex<StdListener>,
    files: RunFiles,
    /// Where connections to the run's mark go.
    way: Option<Way>,
    pub backend: Arc<dyn Backend>,
    pub leases: Arc<Leases>,
    pub limit: Arc<ConnectionLimit>,
    /// Takes the connections that send other requests.
    pub others: Sender<Transfer>,
    pub ended: watch::Receiver<bool>,
    /// Urgent requests that may still be answered without a permit.
    pub unbound: Semaphore,
    /// The current thread, which serves silent connections.
    current: Mutex<(UnboundedSender<Transfer>, Arc<Turn>)>,
}

impl Reception {
    /// Prepares to accept connections.
    pub fn new(
        (listener, files, way): (StdListener, RunFiles, Option<Way>),
        backend: Arc<dyn Backend>,
        others: Sender<Transfer>,
        ended: watch::Receiver<bool>,
    ) -> Arc<Self> {
        let leases = Arc::new(Leases::new(backend.clone()));
        let limit = ConnectionLimit::new(leases.clone());
        let unbound = Semaphore::new(MAX_WITHOUT_PERMIT);
        let current = Mutex::new((unbounded_channel().0, Arc::default()));
        let listener = Mutex::new(listener);
        Arc::new(Self { listener, files, way, backend, leases, limit, others, ended, unbound, current })
    }

    /// Opens the socket again if it was removed; `None`: it is there, or cannot be opened now.
    fn restored(&self) -> Option<io::Result<UnixListener>> {
        let opened = self.files.restore()?;
        let copy = opened.try_clone();
        *lock(&self.listener) = opened;
        Some(copy.and_then(UnixListener::from_std))
    }

    /// Returns a silent connection to the thread that accepts connections.
    pub fn give_back(&self, silent: Transfer) {
        let current = lock(&self.current);
        current.1.list(silent.permit.number(), &silent.stream);
        // Fails only while the server shuts down.
        let _ = current.0.send(silent);
    }
}

/// Life signs of one thread, and the connections that it serves.
#[derive(Default)]
pub(super) struct Turn {
    beats: AtomicU64,
    /// Another thread has taken its place.
    replaced: AtomicBool,
    served: Mutex<BTreeMap<u64, StdStream>>,
}

/// Lists a connection among those that a thread serves, until dropped.
pub(super) struct Served<'a>(&'a Turn, u64);

impl Turn {
    /// Lists a connection by its number, until the guard is dropped.
    pub fn serves(&self, number: u64, stream: &StdStream) -> Served<'_> {
        self.list(number, stream);
        Served(self, number)
    }

    /// Lists a connection, unless no file descriptor is left.
    fn list(&self, number: u64, stream: &StdStream) {
        if let Ok(copy) = stream.try_clone() {
            lock(&self.served).insert(number, copy);
        }
    }

    /// Closes the connections that a hung thread serves: their clients can connect again.
    fn abandon(&self, reception: &Reception) {
        self.replaced.store(true, Ordering::Relaxed);
        for (number, stream) in std::mem::take(&mut *lock(&self.served)) {
            let _ = stream.shutdown(std::net::Shutdown::Both);
            reception.leases.end_connection(number);
            reception.limit.end_connection(number);
        }
    }
}

impl Drop for Served<'_> {
    fn drop(&mut self) {
        lock(&self.0.served).remove(&self.1);
    }
}

/// The current thread, as the thread `rpc` sees it.
pub(super) struct StopThread {
    reception: Arc<Reception>,
    turn: Arc<Turn>,
    thread: JoinHandle<()>,
    seen: u64,
    missed: u32,
    hung: u32,
}

impl StopThread {
    /// Starts the thread.
    pub fn start(reception: Arc<Reception>) -> io::Result<Self> {
        let (turn, thread) = spawn(&reception)?;
        Ok(Self { reception, turn, thread, seen: 0, missed: 0, hung: 0 })
    }

    /// Replaces the thread if it hangs. To be called with [`BEAT_PERIOD`].
    pub fn check(&mut self) {
        let beats = self.turn.beats.load(Ordering::Relaxed);
        self.missed = if beats == self.seen { self.missed + 1 } else { 0 };
        self.seen = beats;
        if self.missed < MAX_MISSED_BEATS || self.hung == MAX_HUNG {
            return;
        }
        match spawn(&self.reception) {
            Ok((turn, thread)) => {
                tracing::error!("rpc: the thread that answers stops hangs; another one takes its place");
                std::mem::replace(&mut self.turn, turn).abandon(&self.reception);
                (self.thread, self.seen, self.missed, self.hung) = (thread, 0, 0, self.hung + 1);
            }
            Err(e) => tracing::error!("rpc: the thread that answers stops hangs, and cannot be replaced: {e}"),
        }
    }

    /// Waits until the thread has ended, for at most `timeout`: one that hangs does not end.
    pub fn join(self, timeout: Duration) {
        let deadline = Instant::now() + timeout;
        while !self.thread.is_finished() && Instant::now() < deadline {
            std::thread::sleep(POLL_PERIOD);
        }
    }
}

fn spawn(reception: &Arc<Reception>) -> io::Result<(Arc<Turn>, JoinHandle<()>)> {
    let (listener, runtime) = (lock(&reception.listener).try_clone()?, runtime()?);
    let (back, silent) = unbounded_channel();
    let (far, from_far) = unbounded_channel();
    let (turn, shared) = (Arc::new(Turn::default()), reception.clone());
    let mine = turn.clone();
    let thread = std::thread::Builder::new().name("rpc-stop".into()).spawn(move || {
        shared.backend.prepare_urgent_thread();
        until_the_end(runtime, shared.ended.clone(), accept((listener, from_far), shared, mine, silent));
    })?;
    if let Some(way) = &reception.way {
        way.lead_to(far);
    }
    *lock(&reception.current) = (back, turn.clone());
    Ok((turn, thread))
}

/// Accepts connections, and answers the requests that always get through. Opens the socket again if it was removed.
async fn accept(
    (listener, mut far): (StdListener, UnboundedReceiver<StdStream>),
    reception: Arc<Reception>,
    turn: Arc<Turn>,
    mut silent: UnboundedReceiver<Transfer>,
) {
    let mut listener = match UnixListener::from_std(listener) {
        Ok(listener) => listener,
        Err(e) => return tracing::error!("rpc: the socket cannot be served: {e}"),
    };
    let mut beat = tokio::time::interval(BEAT_PERIOD);
    let mut looks = tokio::time::interval(LOOK_PERIOD);
    let mut newcomers = Newcomers::default();
    while !turn.replaced.load(Ordering::Relaxed) {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted.map(|(stream, _)| stream),
            Some(stream) = far.recv() => stream.set_nonblocking(true).and_then(|()| UnixStream::from_std(stream)),
            Some(transfer) = silent.recv() => {
                tokio::spawn(urgent::serve(transfer, reception.clone(), turn.clone()));
                continue;
            }
            _ = beat.tick() => {
                turn.beats.fetch_add(1, Ordering::Relaxed);
                continue;
            }
            _ = looks.tick() => {
                match reception.restored() {
                    Some(Ok(opened)) => listener = opened,
                    Some(Err(e)) => tracing::warn!("rpc: the socket cannot be served: {e}"),
                    None => {}
                }
                continue;
            }
        };
        let stream = match accepted {
            Ok(stream) => stream,
            Err(e) => {
                tracing::warn!("rpc: cannot serve a connection: {e}");
                tokio::time::sleep(ACCEPT_PAUSE).await;
                turn.beats.fetch_add(1, Ordering::Relaxed);
                continue;
            }
        };
        if is_owner_or_root(&stream) {
            tokio::spawn(urgent::receive(stream, newcomers.enter(), reception.clone(), turn.clone()));
        } else {
            refuse(&stream, RpcError::new(Code::Forbidden, "this run belongs to another user"));
        }
    }
}

/// Connections that have sent no line yet, the oldest first.
#[derive(Default)]
struct Newcomers(VecDeque<oneshot::Sender<()>>);

impl Newcomers {
    /// Adds one. Its receiver ends when it must make room for a newer one: a flood of
    /// connections leaves each of them the time to send a request.
    fn enter(&mut self) -> oneshot::Receiver<()> {
        self.0.retain(|newcomer| !newcomer.is_closed());
        if self.0.len() == MAX_WITHOUT_PERMIT {
            self.0.pop_front();
        }
        let (sender, receiver) = oneshot::channel();
        self.0.push_back(sender);
        receiver
    }
}
