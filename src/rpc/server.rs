//! The run's end of the socket: takes connections and hands each to a conversation of its own.
//!
//! One thread with one tokio runtime; nothing here is real-time, and nothing real-time waits for it.

use std::io;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::UnixListener as StdListener;
use std::path::Path;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use tokio::net::{UnixListener, UnixStream};
use tokio::sync::{Semaphore, oneshot};

use super::api::{Backend, MAX_CONNECTIONS};
use super::connection;
use super::error::{Code, RpcError};
use super::lease::{Leases, Lessee};
use super::place::Claim;
use super::wire;

/// Longest time that a request may take.
pub const CALL_LIMIT: Duration = Duration::from_secs(10);
/// Time for the last replies to leave when the server ends.
const LAST_WORDS: Duration = Duration::from_millis(50);
/// Pause after the system refused a connection (no file descriptors left).
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// A running server. Ends, and removes its socket, when it is dropped.
#[derive(Debug)]
pub struct Server {
    claim: Claim,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Server {
    /// Opens the socket of a claimed name and answers from now on.
    pub fn start(claim: Claim, backend: Arc<dyn Backend>) -> io::Result<Self> {
        let listener = StdListener::bind(claim.socket())?;
        // The folder is closed to others, so nobody could connect before this.
        std::fs::set_permissions(claim.socket(), std::fs::Permissions::from_mode(0o600))?;
        listener.set_nonblocking(true)?;
        let runtime = tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build()?;
        let (stop, stopped) = oneshot::channel();
        let thread = std::thread::Builder::new().name("rpc".into()).spawn(move || {
            runtime.block_on(async {
                tokio::select! {
                    () = accept(listener, backend) => {}
                    _ = stopped => tokio::time::sleep(LAST_WORDS).await,
                }
            });
            // A large file that is still being read does not keep the run from ending.
            runtime.shutdown_background();
        })?;
        Ok(Self { claim, stop: Some(stop), thread: Some(thread) })
    }

    /// Where it listens.
    pub fn socket(&self) -> &Path {
        self.claim.socket()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        if let Some(stop) = self.stop.take() {
            let _ = stop.send(());
        }
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

async fn accept(listener: StdListener, backend: Arc<dyn Backend>) {
    let listener = match UnixListener::from_std(listener) {
        Ok(listener) => listener,
        Err(e) => return tracing::error!("rpc: the socket cannot be served: {e}"),
    };
    let leases = Arc::new(Leases::default());
    let mut connections = 0;
    let room = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    loop {
        let stream = match listener.accept().await {
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
        let Ok(seat) = room.clone().try_acquire_owned() else {
            let error = RpcError::new(Code::TooManyConnections, format!("all {MAX_CONNECTIONS} connections are taken"));
            refuse(&stream, error.hint("close one, or ask several things over one connection"));
            continue;
        };
        connections += 1;
        let pid = stream.peer_cred().ok().and_then(|peer| peer.pid());
        let lessee = Lessee::new(leases.clone(), connections, pid);
        let backend = backend.clone();
        tokio::spawn(async move {
            connection::serve(stream, backend, lessee).await;
            drop(seat);
        });
    }
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
