//! The run's end of the socket: takes connections and answers them.
//!
//! ```text
//! socket ─▶ thread `rpc-stop`: stop, cancel, status, shutdown ──all else──▶ `rpc` ─▶ a thread per connection
//!                    ▲──────────── connections that say nothing for a while ───────────────────┘
//! ```
//!
//! A connection that asks more than the requests that always get through has its own thread: what one client
//! sends delays no other client, and the thread that stops arms is idle but for that. Nothing here is real-time, and
//! nothing real-time waits for it.

use std::io;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::UnixListener as StdListener;
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::JoinHandle;
use std::time::Duration;

use tokio::net::{UnixListener, UnixStream};
use tokio::runtime::Runtime;
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};
use tokio::sync::watch;

use super::api::Backend;
use super::connection;
use super::error::{Code, RpcError};
use super::lease::{Leases, Lessee};
use super::place::Claim;
use super::seats::Seats;
use super::urgent::{self, Arrival};
use super::wire;

/// Longest time that a request may take.
pub const CALL_LIMIT: Duration = Duration::from_secs(10);
/// Time for the last replies to leave when the server ends.
const LAST_WORDS: Duration = Duration::from_millis(50);
/// How long the connections' threads get to end.
const END_LIMIT: Duration = Duration::from_secs(1);
/// Pause after the system refused a connection (no file descriptors left).
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// Stack of a connection's thread [bytes].
const STACK: usize = 1 << 20;

/// A running server. Ends, and removes its socket, when it is dropped.
#[derive(Debug)]
pub struct Server {
    claim: Claim,
    end: watch::Sender<bool>,
    threads: Vec<JoinHandle<()>>,
}

impl Server {
    /// Opens the socket of a claimed name and answers from now on.
    pub fn start(claim: Claim, backend: Arc<dyn Backend>) -> io::Result<Self> {
        let listener = StdListener::bind(claim.socket())?;
        // The folder is closed to others, so no client could connect before this.
        std::fs::set_permissions(claim.socket(), std::fs::Permissions::from_mode(0o600))?;
        listener.set_nonblocking(true)?;
        let runtime = runtime()?;
        let (end, ended) = watch::channel(false);
        let (arrivals, arrived) = channel();
        let (back, silent) = unbounded_channel();
        let (first, others) = (backend.clone(), ended.clone());
        let taking = std::thread::Builder::new().name("rpc-stop".into()).spawn(move || {
            first.prepare_urgent_thread();
            until_the_end(runtime, ended, accept(listener, first, arrivals, silent));
        })?;
        let mut server = Self { claim, end, threads: vec![taking] };
        let serving = std::thread::Builder::new().name("rpc".into());
        server.threads.push(serving.spawn(move || converse(&arrived, &back, &backend, &others))?);
        Ok(server)
    }

    /// Where it listens.
    pub fn socket(&self) -> &Path {
        self.claim.socket()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.end.send(true);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

fn runtime() -> io::Result<Runtime> {
    tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build()
}

/// Runs a task until it is done or the server ends; then replies get a moment to leave.
fn until_the_end(runtime: Runtime, mut ended: watch::Receiver<bool>, task: impl Future<Output = ()> + Send + 'static) {
    runtime.block_on(async {
        tokio::select! {
            _ = tokio::spawn(task) => {}
            _ = ended.wait_for(|ended| *ended) => tokio::time::sleep(LAST_WORDS).await,
        }
    });
    // A large file that is still being read does not keep the run from ending.
    runtime.shutdown_background();
}

/// Takes connections, and answers what always gets through.
async fn accept(
    listener: StdListener,
    backend: Arc<dyn Backend>,
    others: Sender<Arrival>,
    mut silent: UnboundedReceiver<Arrival>,
) {
    let listener = match UnixListener::from_std(listener) {
        Ok(listener) => listener,
        Err(e) => return tracing::error!("rpc: the socket cannot be served: {e}"),
    };
    let leases = Arc::new(Leases::default());
    let seats = Seats::new(leases.clone());
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            Some(arrival) = silent.recv() => {
                tokio::spawn(urgent::serve(arrival, backend.clone(), others.clone()));
                continue;
            }
        };
        let stream = match accepted {
            Ok((stream, _)) => stream,
            Err(e) => {
                tracing::warn!("rpc: a connection was not taken: {e}");
                tokio::time::sleep(ACCEPT_PAUSE).await;
                continue;
            }
        };
        if !is_owner_or_root(&stream) {
            refuse(&stream, RpcError::new(Code::Forbidden, "this run belongs to another user"));
            continue;
        }
        let seat = match seats.take() {
            Ok(seat) => seat,
            Err(error) => {
                refuse(&stream, error);
                continue;
            }
        };
        let pid = stream.peer_cred().ok().and_then(|peer| peer.pid());
        let lessee = Lessee::new(leases.clone(), seat.number(), pid);
        let Ok(stream) = stream.into_std() else { continue };
        let arrival = Arrival { stream, read: Vec::new(), lessee, seat };
        tokio::spawn(urgent::serve(arrival, backend.clone(), others.clone()));
    }
}

/// Gives each connection that is handed on a thread, until the last one that could be has gone.
fn converse(
    arrived: &Receiver<Arrival>,
    back: &UnboundedSender<Arrival>,
    backend: &Arc<dyn Backend>,
    ended: &watch::Receiver<bool>,
) {
    // Hangs up when the last thread that has its other end is gone.
    let (alive, gone) = channel::<()>();
    for arrival in arrived {
        let (backend, back, ended, alive) = (backend.clone(), back.clone(), ended.clone(), alive.clone());
        let thread = std::thread::Builder::new().name("rpc-client".into()).stack_size(STACK);
        let started = thread.spawn(move || {
            match runtime() {
                Ok(runtime) => until_the_end(runtime, ended, async move {
                    if let Some(silent) = connection::serve(arrival, backend).await {
                        // Fails only when the server is ending.
                        let _ = back.send(silent);
                    }
                }),
                Err(e) => tracing::warn!("rpc: a connection was not taken: {e}"),
            }
            drop(alive);
        });
        if let Err(e) = started {
            tracing::warn!("rpc: a connection was not taken: {e}");
        }
    }
    drop(alive);
    let _ = gone.recv_timeout(END_LIMIT);
}

fn is_owner_or_root(stream: &UnixStream) -> bool {
    let us = rustix::process::geteuid().as_raw();
    stream.peer_cred().is_ok_and(|peer| peer.uid() == us || peer.uid() == 0)
}

/// Says why and lets go. A fresh socket has room for a line, so this never waits.
fn refuse(stream: &UnixStream, error: RpcError) {
    let line = wire::reply::<()>(&serde_json::Value::Null, Err(error));
    let _ = stream.try_write(line.as_bytes());
}
