//! The thread `rpc-stop`: accepts connections and answers the requests that always get through. If it hangs, another
//! one takes its place, and what waited for it.
//!
//! ```text
//! new connection ─▶ at most 256 that have sent no line yet ─ stop, cancel, shutdown ─▶ answered without a permit
//!                                                          └ all else ─▶ permit ─▶ `urgent::serve`
//! ```

use std::collections::VecDeque;
use std::io;
use std::os::unix::net::{UnixListener as StdListener, UnixStream as StdStream};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::Sender;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use tokio::net::{UnixListener, UnixStream};
use tokio::sync::{oneshot, watch};

use crate::api::Backend;
use crate::error::{Code, RpcError};
use crate::run_dir::mark::is_owner_or_root;
use crate::server::connection_limit::ConnectionLimit;
use crate::server::handover::Handover;
use crate::server::lease::Leases;
use crate::server::turn::{MAX_WITHOUT_PERMIT, Turn};
use crate::server::urgent::{self, Transfer};
use crate::server::{refuse, runtime, until_the_end};

/// Period of the thread's heartbeat, and of [`StopThread::check`].
pub(crate) const BEAT_PERIOD: Duration = Duration::from_millis(100);
/// Consecutive checks without a heartbeat after which the thread hangs. Counted, not timed: where the whole process was
/// stopped, no thread hangs.
const MAX_MISSED_BEATS: u32 = 5;
/// Maximum number of threads that hang at the same time and are replaced.
const MAX_HUNG: usize = 3;
/// Pause after a failed accept (no file descriptors left).
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// Poll period of the thread's end.
const POLL_PERIOD: Duration = Duration::from_millis(10);

/// What the threads of a server share, also one that hangs and its replacement.
pub(crate) struct Reception {
    /// The open socket: another one once it was opened again.
    pub listeners: watch::Receiver<Arc<StdListener>>,
    /// Connections to the run's mark.
    pub far: Arc<Handover<StdStream>>,
    /// Silent connections that come back.
    pub silent: Handover<Transfer>,
    pub backend: Arc<dyn Backend>,
    pub leases: Arc<Leases>,
    pub limit: Arc<ConnectionLimit>,
    /// Takes the connections that send other requests.
    pub others: Sender<Transfer>,
    pub ended: watch::Receiver<bool>,
}

impl Reception {
    /// Prepares to accept connections.
    pub fn new(
        listeners: watch::Receiver<Arc<StdListener>>,
        backend: Arc<dyn Backend>,
        others: Sender<Transfer>,
        ended: watch::Receiver<bool>,
    ) -> Arc<Self> {
        let leases = Arc::new(Leases::new(backend.clone()));
        let limit = ConnectionLimit::new(leases.clone());
        let (far, silent) = (Arc::default(), Handover::default());
        Arc::new(Self { listeners, far, silent, backend, leases, limit, others, ended })
    }
}

/// The current thread, as the thread `rpc` sees it.
pub(crate) struct StopThread {
    reception: Arc<Reception>,
    turn: Arc<Turn>,
    thread: JoinHandle<()>,
    seen: u64,
    missed: u32,
    /// Threads that were replaced and have not ended: one that recovers ends.
    hung: Vec<JoinHandle<()>>,
}

impl StopThread {
    /// Starts the thread.
    pub fn start(reception: Arc<Reception>) -> io::Result<Self> {
        let (turn, thread) = spawn(&reception)?;
        Ok(Self { reception, turn, thread, seen: 0, missed: 0, hung: Vec::new() })
    }

    /// Replaces the thread if it hangs. To be called with [`BEAT_PERIOD`].
    pub fn check(&mut self) {
        let beats = self.turn.beats.load(Ordering::Relaxed);
        self.missed = if beats == self.seen { self.missed.saturating_add(1) } else { 0 };
        self.seen = beats;
        if self.missed < MAX_MISSED_BEATS {
            return;
        }
        self.hung.retain(|thread| !thread.is_finished());
        if self.hung.len() >= MAX_HUNG {
            if self.missed == MAX_MISSED_BEATS {
                tracing::error!(
                    "rpc: the thread that answers stops hangs, like {MAX_HUNG} before it: stop the arms with their own \
                     stop, and end the run with a signal"
                );
            }
            return;
        }
        match spawn(&self.reception) {
            Ok((turn, thread)) => {
                tracing::error!("rpc: the thread that answers stops hangs; another one takes its place");
                std::mem::replace(&mut self.turn, turn).abandon(&self.reception);
                self.hung.push(std::mem::replace(&mut self.thread, thread));
                (self.seen, self.missed) = (0, 0);
            }
            Err(e) if self.missed == MAX_MISSED_BEATS => {
                tracing::error!("rpc: the thread that answers stops hangs, and cannot be replaced yet: {e}");
            }
            Err(_) => {}
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
    let (runtime, turn, shared) = (runtime()?, Arc::new(Turn::default()), reception.clone());
    let mine = turn.clone();
    let thread = std::thread::Builder::new().name("rpc-stop".into()).spawn(move || {
        shared.backend.prepare_urgent_thread();
        until_the_end(runtime, shared.ended.clone(), accept(shared, mine));
    })?;
    Ok((turn, thread))
}

/// Accepts connections, and answers the requests that always get through.
async fn accept(reception: Arc<Reception>, turn: Arc<Turn>) {
    let mut listeners = reception.listeners.clone();
    listeners.mark_changed();
    let mut listener: Option<UnixListener> = None;
    let mut beat = tokio::time::interval(BEAT_PERIOD);
    let mut newcomers = Newcomers::default();
    while !turn.is_replaced() {
        let accepted = tokio::select! {
            accepted = next(listener.as_ref()) => accepted,
            Ok(()) = listeners.changed() => {
                let opened = listeners.borrow_and_update().try_clone();
                match opened.and_then(UnixListener::from_std) {
                    Ok(opened) => {
                        listener = Some(opened);
                        continue;
                    }
                    Err(e) => {
                        // Tried again, for example once there are file descriptors: no other thread serves it.
                        listeners.mark_changed();
                        Err(e)
                    }
                }
            }
            stream = reception.far.take() => streaming(stream),
            transfer = reception.silent.take() => {
                tokio::spawn(urgent::serve(transfer, reception.clone(), turn.clone()));
                continue;
            }
            _ = beat.tick() => {
                turn.beats.fetch_add(1, Ordering::Relaxed);
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

/// Waits for a connection to the socket, once it is open.
async fn next(listener: Option<&UnixListener>) -> io::Result<UnixStream> {
    match listener {
        Some(listener) => Ok(listener.accept().await?.0),
        None => std::future::pending().await,
    }
}

fn streaming(stream: StdStream) -> io::Result<UnixStream> {
    stream.set_nonblocking(true)?;
    UnixStream::from_std(stream)
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
