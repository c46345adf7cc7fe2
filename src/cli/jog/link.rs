//! The connection of jog to a run on another computer: when it is lost, jog connects again, and its user decides when
//! jog continues. A key that is still held then moves nothing.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};
use std::thread::sleep;
use std::time::Duration;

use crate::cli::exit::Failure;
use crate::cli::lasting;
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::error::Code;

/// Pause between two attempts.
const PAUSE: Duration = Duration::from_millis(200);

/// The state of the connection.
pub enum Link {
    /// Targets can be sent.
    Up,
    /// It is lost, and being opened again.
    Lost(Connecting),
    /// It is open again; the user has not taken the lease yet.
    Back,
}

/// Attempts on a thread, until they are dropped.
pub struct Connecting {
    clients: Receiver<Client>,
    _wanted: Arc<()>,
}

impl Link {
    /// Begins to connect to a run again.
    pub fn lost(run: &str) -> Self {
        let (wanted, (found, clients)) = (Arc::new(()), channel());
        let (still, run) = (Arc::downgrade(&wanted), run.to_owned());
        let connecting = move || {
            if let Some(client) = attempts(&run, || still.strong_count() > 0) {
                let _ = found.send(client);
            }
        };
        // Without a thread jog shows that it is lost, and can be left.
        let _ = std::thread::Builder::new().name("jog-link".into()).spawn(connecting);
        Self::Lost(Connecting { clients, _wanted: wanted })
    }
}

impl Connecting {
    /// Returns the new connection, once.
    pub fn back(&self) -> Option<Client> {
        self.clients.try_recv().ok()
    }
}

/// Connects to a run, until it is there or no longer wanted.
pub fn attempts(run: &str, wanted: impl Fn() -> bool) -> Option<Client> {
    while wanted() {
        sleep(PAUSE);
        if let Ok(client) = lasting::attempt(run) {
            return Some(client);
        }
    }
    None
}

/// Returns the failure for a lost connection.
pub fn lost(error: ClientError) -> Failure {
    Failure { code: Code::Lost.name(), ..error.into() }
}

/// Returns whether a failure is a lost connection to another computer.
pub fn is_loss(failure: &Failure) -> bool {
    failure.code == Code::Lost.name() && crate::cli::arguments::place().is_some()
}
