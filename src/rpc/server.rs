//! The server of a run's socket: accepts connections and answers their requests.
//!
//! ```text
//! socket ─▶ thread `rpc-stop`: stop, cancel, status, shutdown ──all else──▶ `rpc` ─▶ a thread per connection
//!                    ▲──────────── connections that are silent for a while ────────────────────┘
//! ```
//!
//! A connection that sends other requests than those that always get through has its own thread: no client delays
//! another one, and `rpc-stop` does nothing but accept and answer these. Nothing here is real-time, and no real-time
//! thread waits for it.

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
use super::connection_limit::ConnectionLimit;
use super::error::{Code, RpcError};
use super::lease::{Leases, Lessee};
use super::run_dir::Claim;
use super::urgent::{self, Transfer};
use super::wire;

/// Maximum duration of a request.
pub const CALL_TIMEOUT: Duration = Duration::from_secs(10);
/// Grace period for the last replies at shutdown.
const FLUSH_TIME: Duration = Duration::from_millis(50);
/// Maximum time for the threads of connections to end at shutdown.
const JOIN_TIMEOUT: Duration = Duration::from_secs(1);
/// Pause after a failed accept (no file descriptors left).
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// Stack size of a connection's thread [bytes].
const STACK: usize = 1 << 20;

/// A running server. Shuts down and removes its socket when dropped.
#[derive(Debug)]
pub struct Server {
    claim: Claim,
    end: watch::Sender<bool>,
    threads: Vec<JoinHandle<()>>,
}

impl Server {
    /// Opens the socket of a claimed name and starts serving it.
    pub fn start(claim: Claim, backend: Arc<dyn Backend>) -> io::Result<Self> {
        let listener = StdListener::bind(claim.socket())?;
        // The directory is closed to other users, so none of them could connect before this.
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
        server.threads.push(serving.spawn(move || serve_passed_on(&arrived, &back, &backend, &others))?);
        Ok(server)
    }

    /// Returns the path of its socket.
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

/// Runs a task until it is done or the server shuts down; then waits [`FLUSH_TIME`] for replies.
fn until_the_end(runtime: Runtime, mut ended: watch::Receiver<bool>, task: impl Future<Output = ()> + Send + 'static) {
    runtime.block_on(async {
        tokio::select! {
            _ = tokio::spawn(task) => {}
            _ = ended.wait_for(|ended| *ended) => tokio::time::sleep(FLUSH_TIME).await,
        }
    });
    // Does not wait for a large file that is still being read.
    runtime.shutdown_background();
}

/// Accepts connections, and answers the requests that always get through.
async fn accept(
    listener: StdListener,
    backend: Arc<dyn Backend>,
    others: Sender<Transfer>,
    mut silent: UnboundedReceiver<Transfer>,
) {
    let listener = match UnixListener::from_std(listener) {
        Ok(listener) => listener,
        Err(e) => return tracing::error!("rpc: the socket cannot be served: {e}"),
    };
    let leases = Arc::new(Leases::new(backend.clone()));
    let limit = ConnectionLimit::new(leases.clone());
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            Some(transfer) = silent.recv() => {
                tokio::spawn(urgent::serve(transfer, backend.clone(), others.clone()));
                continue;
            }
        };
        let stream = match accepted {
            Ok((stream, _)) => stream,
            Err(e) => {
                tracing::warn!("rpc: cannot serve a connection: {e}");
                tokio::time::sleep(ACCEPT_PAUSE).await;
                continue;
            }
        };
        if !is_owner_or_root(&stream) {
            refuse(&stream, RpcError::new(Code::Forbidden, "this run belongs to another user"));
            continue;
        }
        let permit = match limit.acquire() {
            Ok(permit) => permit,
            Err(error) => {
                refuse(&stream, error);
                continue;
            }
        };
        let pid = stream.peer_cred().ok().and_then(|peer| peer.pid());
        let lessee = Lessee::new(leases.clone(), permit.number(), pid);
        let Ok(stream) = stream.into_std() else { continue };
        let transfer = Transfer { stream, read: Vec::new(), lessee, permit };
        tokio::spawn(urgent::serve(transfer, backend.clone(), others.clone()));
    }
}

/// Starts a thread for each connection that is passed on. Returns after the shutdown, when the threads have ended or
/// after [`JOIN_TIMEOUT`].
fn serve_passed_on(
    arrived: &Receiver<Transfer>,
    back: &UnboundedSender<Transfer>,
    backend: &Arc<dyn Backend>,
    ended: &watch::Receiver<bool>,
) {
    // Disconnected once the last thread has dropped its sender.
    let (alive, ended_threads) = channel::<()>();
    for transfer in arrived {
        let (backend, back, ended, alive) = (backend.clone(), back.clone(), ended.clone(), alive.clone());
        let thread = std::thread::Builder::new().name("rpc-client".into()).stack_size(STACK);
        let started = thread.spawn(move || {
            match runtime() {
                Ok(runtime) => until_the_end(runtime, ended, async move {
                    if let Some(silent) = connection::serve(transfer, backend).await {
                        // Fails only while the server shuts down.
                        let _ = back.send(silent);
                    }
                }),
                Err(e) => tracing::warn!("rpc: cannot serve a connection: {e}"),
            }
            drop(alive);
        });
        if let Err(e) = started {
            tracing::warn!("rpc: cannot serve a connection: {e}");
        }
    }
    drop(alive);
    let _ = ended_threads.recv_timeout(JOIN_TIMEOUT);
}

fn is_owner_or_root(stream: &UnixStream) -> bool {
    let us = rustix::process::geteuid().as_raw();
    stream.peer_cred().is_ok_and(|peer| peer.uid() == us || peer.uid() == 0)
}

/// Sends an error and closes the connection. Never blocks: a new socket's buffer is empty.
fn refuse(stream: &UnixStream, error: RpcError) {
    let line = wire::reply::<()>(&serde_json::Value::Null, Err(error));
    let _ = stream.try_write(line.as_bytes());
}
