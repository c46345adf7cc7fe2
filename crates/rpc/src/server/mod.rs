//! The server of a run's socket: accepts connections and answers their requests.
//!
//! ```text
//! socket ─▶ thread `rpc-stop`: stop, cancel, status, shutdown ──all else──▶ `rpc` ─▶ a thread per connection
//!                    ▲──────────── connections that are silent for a while ────────────────────┘
//! ```
//!
//! A connection that sends other requests than those that always get through has its own thread: no client delays
//! another one, and `rpc-stop` does nothing but accept and answer these; a hung one is replaced. Nothing here is
//! real-time, and no real-time thread waits for it.

pub(crate) mod commanded;
pub(crate) mod connection;
pub(crate) mod connection_limit;
pub(crate) mod handover;
pub(crate) mod lease;
pub(crate) mod line_reader;
pub mod planner_proxy;
pub(crate) mod stop_thread;
pub mod streams;
pub(crate) mod subscription;
pub(crate) mod turn;
pub(crate) mod urgent;
pub mod who;

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use tokio::net::UnixStream;
use tokio::runtime::Runtime;
use tokio::sync::watch;

use crate::api::Backend;
use crate::error::RpcError;
use crate::run_dir::Claim;
use crate::run_dir::look::Look;
use crate::run_dir::mark::Way;
use crate::server::stop_thread::{BEAT_PERIOD, Reception, StopThread};
use crate::server::urgent::Transfer;
use crate::wire;

/// Maximum duration of a request.
pub const CALL_TIMEOUT: Duration = Duration::from_secs(10);
/// Grace period for the last replies at shutdown.
const FLUSH_TIME: Duration = Duration::from_millis(50);
/// Maximum time for the threads of connections to end at shutdown.
const JOIN_TIMEOUT: Duration = Duration::from_secs(1);
/// Stack size of a connection's thread [bytes].
const STACK: usize = 1 << 20;

/// A running server. Shuts down and removes its socket when dropped.
#[derive(Debug)]
pub struct Server {
    claim: Claim,
    socket: PathBuf,
    end: watch::Sender<bool>,
    look: Option<Look>,
    /// The thread `rpc`.
    thread: Option<JoinHandle<()>>,
}

impl Server {
    /// Opens the socket of a claimed name and starts serving it.
    pub fn start(claim: Claim, backend: Arc<dyn Backend>) -> io::Result<Self> {
        who::read_users();
        let files = claim.files();
        let (opened, listeners) = watch::channel(Arc::new(files.bind()?));
        let (end, ended) = watch::channel(false);
        let (arrivals, arrived) = channel();
        let reception = Reception::new(listeners, backend, arrivals, ended);
        let stop_thread = StopThread::start(reception.clone())?;
        let look = Look::start(files, opened)?;
        claim.lead(Way::To(reception.far.clone()));
        let socket = claim.socket();
        let serving = std::thread::Builder::new().name("rpc".into());
        let thread = serving.spawn(move || serve_passed_on(&arrived, &reception, stop_thread));
        // If there is no thread, `end` is dropped, which ends the other one.
        Ok(Self { claim, socket, end, look: Some(look), thread: Some(thread?) })
    }

    /// Returns the path that its socket had at the start.
    pub fn socket(&self) -> &Path {
        &self.socket
    }

    /// Returns the claim that it serves.
    pub fn claim(&self) -> &Claim {
        &self.claim
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.end.send(true);
        self.look = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
        self.claim.lead(Way::Nowhere);
    }
}

/// Creates the runtime of a thread.
pub(crate) fn runtime() -> io::Result<Runtime> {
    tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build()
}

/// Runs a task until it is done or the server shuts down; then waits [`FLUSH_TIME`] for replies.
pub(crate) fn until_the_end(
    runtime: Runtime,
    mut ended: watch::Receiver<bool>,
    task: impl Future<Output = ()> + Send + 'static,
) {
    runtime.block_on(async {
        tokio::select! {
            _ = tokio::spawn(task) => {}
            _ = ended.wait_for(|ended| *ended) => tokio::time::sleep(FLUSH_TIME).await,
        }
    });
    // Does not wait for a large file that is still being read.
    runtime.shutdown_background();
}

/// Starts a thread for each connection that is passed on, and replaces a hung `rpc-stop`. Returns after the shutdown,
/// when the threads have ended or after [`JOIN_TIMEOUT`].
fn serve_passed_on(arrived: &Receiver<Transfer>, reception: &Arc<Reception>, mut stop_thread: StopThread) {
    // Disconnected once the last thread has dropped its sender.
    let (alive, ended_threads) = channel::<()>();
    let mut checked = Instant::now();
    while !*reception.ended.borrow() {
        if let Ok(transfer) = arrived.recv_timeout(BEAT_PERIOD) {
            start_client(transfer, reception.clone(), alive.clone());
        }
        if checked.elapsed() >= BEAT_PERIOD {
            checked = Instant::now();
            stop_thread.check();
        }
    }
    drop(alive);
    stop_thread.join(JOIN_TIMEOUT);
    let _ = ended_threads.recv_timeout(JOIN_TIMEOUT);
}

/// Starts the thread of a connection, which drops `alive` at its end.
fn start_client(transfer: Transfer, reception: Arc<Reception>, alive: Sender<()>) {
    let thread = std::thread::Builder::new().name("rpc-client".into()).stack_size(STACK);
    let started = thread.spawn(move || {
        match runtime() {
            Ok(runtime) => until_the_end(runtime, reception.ended.clone(), async move {
                if let Some(silent) =
                    connection::serve(transfer, reception.backend.clone(), reception.ended.clone()).await
                {
                    reception.silent.put(silent);
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

/// Sends an error and closes the connection. Never blocks: a new socket's buffer is empty.
pub(crate) fn refuse(stream: &UnixStream, error: RpcError) {
    let line = wire::reply::<()>(&serde_json::Value::Null, Err(error));
    let _ = stream.try_write(line.as_bytes());
}
