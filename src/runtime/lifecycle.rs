//! How far a run is: started, closed to requests, without its tick.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use super::Ending;
use dimos_core::sync::lock;
use dimos_rpc::run_dir::Claim;

/// The life of a run.
pub struct Lifecycle {
    started: Instant,
    endings: Sender<Ending>,
    closed: AtomicBool,
    /// Whether the tick still runs: stops are accepted although the run is closed.
    stoppable: AtomicBool,
    /// A client cancelled motion after the run was closed.
    cancelled: AtomicBool,
    /// The lock on the run's name, of a run without a server.
    claim: Mutex<Option<Claim>>,
}

impl Lifecycle {
    /// Begins. `endings` receives why the run is to end.
    pub fn new(endings: Sender<Ending>) -> Self {
        Self {
            started: Instant::now(),
            endings,
            closed: AtomicBool::new(false),
            stoppable: AtomicBool::new(true),
            cancelled: AtomicBool::new(false),
            claim: Mutex::new(None),
        }
    }

    /// Returns the time since the start.
    pub fn uptime(&self) -> Duration {
        self.started.elapsed()
    }

    /// Asks for the end of the run.
    pub fn end(&self, why: Ending) {
        let _ = self.endings.send(why);
    }

    /// Keeps the lock on the run's name if there is no server.
    pub fn keep(&self, claim: Claim) {
        *lock(&self.claim) = Some(claim);
    }

    /// Rejects new requests from now on.
    pub fn close(&self) {
        self.closed.store(true, Ordering::Release);
    }

    /// Returns whether the run is shutting down.
    pub fn is_closed(&self) -> bool {
        self.closed.load(Ordering::Acquire)
    }

    /// Accepts no more stops: the tick ends.
    pub fn end_stops(&self) {
        self.stoppable.store(false, Ordering::Release);
    }

    /// Returns whether stops and cancels are still accepted.
    pub fn accepts_stops(&self) -> bool {
        self.stoppable.load(Ordering::Acquire)
    }

    /// Records that a client cancelled motion after the run was closed.
    pub fn cancel(&self) {
        self.cancelled.store(true, Ordering::Release);
    }

    /// Returns whether a client cancelled motion after the run was closed.
    pub fn was_cancelled(&self) -> bool {
        self.cancelled.load(Ordering::Acquire)
    }
}
