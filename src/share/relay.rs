//! A socket on this computer that leads to a run on another one: what only knows sockets of runs works with it, and
//! connects again when the run is back. Each connection is a client of its own.

use std::io::{Read, Write};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use serde_json::json;

use super::place::Place;
use super::{connection, remote_runs};
use dimos_rpc::client::ClientError;
use dimos_rpc::error::{Code, RpcError};
use dimos_rpc::run_dir::{Claim, RunDir};

/// Time for the client to read why there is no connection.
const REFUSAL: Duration = Duration::from_secs(1);

/// The socket. Closed and removed when dropped; connections continue.
#[derive(Debug)]
pub struct Relay {
    socket: PathBuf,
    _claim: Claim,
    ended: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Relay {
    /// Opens a socket that leads to the run of this name at a place.
    pub fn start(place: &str, run: &str) -> Result<Self, ClientError> {
        static NUMBER: AtomicU32 = AtomicU32::new(0);
        let place = remote_runs::find(place)?;
        let folder = RunDir::standard().relays();
        folder.tidy()?;
        let claim = folder.claim(&format!("{}-{}", std::process::id(), NUMBER.fetch_add(1, Ordering::Relaxed)))?;
        let failed = |error| ClientError::Io { run: run.to_owned(), error };
        let listener = UnixListener::bind(claim.socket()).map_err(failed)?;
        let rights = std::fs::Permissions::from_mode(0o600);
        std::fs::set_permissions(claim.socket(), rights).map_err(failed)?;
        let ended = Arc::new(AtomicBool::new(false));
        let (end, run_name) = (ended.clone(), run.to_owned());
        let thread = std::thread::Builder::new()
            .name("relay".into())
            .spawn(move || accept(&listener, &place, &run_name, &end))
            .map_err(failed)?;
        Ok(Self { socket: claim.socket(), _claim: claim, ended, thread: Some(thread) })
    }

    /// Returns the path of the socket.
    pub fn socket(&self) -> &Path {
        &self.socket
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.ended.store(true, Ordering::Release);
        // Wakes the thread.
        let _ = UnixStream::connect(&self.socket);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn accept(listener: &UnixListener, place: &Place, run: &str, ended: &AtomicBool) {
    for stream in listener.incoming() {
        if ended.load(Ordering::Acquire) {
            return;
        }
        let Ok(stream) = stream else {
            // No file descriptors left.
            std::thread::sleep(Duration::from_millis(100));
            continue;
        };
        let (place, run) = (place.clone(), run.to_owned());
        let connecting = move || connect(stream, &place, &run);
        // Without a thread the connection is closed: its owner tries again.
        let _ = std::thread::Builder::new().name("relay-open".into()).spawn(connecting);
    }
}

/// Joins a connection with the run. Where it cannot be reached, the connection gets the reason, as a run refuses one.
fn connect(mut stream: UnixStream, place: &Place, run: &str) {
    let opened = remote_runs::open(place, Some(run), remote_runs::AGAIN_TIMEOUT);
    let served = opened.and_then(|(session, run)| {
        let other = stream.try_clone().map_err(|error| ClientError::Io { run: run.clone(), error })?;
        connection::serve(session, place, &run, other).map_err(|error| ClientError::Io { run, error })
    });
    let Err(error) = served else { return };
    let refusal = match error {
        ClientError::Refused(refusal) => refusal,
        other => RpcError::new(Code::Unreachable, format!("{}: {other}", place.name)),
    };
    let _ = stream.write_all(format!("{}\n", json!({"id": null, "error": refusal})).as_bytes());
    let _ = stream.shutdown(std::net::Shutdown::Write);
    // Until the client has closed its end: what it has sent would otherwise discard the refusal.
    let _ = stream.set_read_timeout(Some(REFUSAL));
    let _ = stream.take(1 << 20).read_to_end(&mut Vec::new());
}
