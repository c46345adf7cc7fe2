//! Events of emulators: clients that connect and disconnect, faults that begin. Recorded only after [`open`], as in
//! `dimos adapter emulate`. Recording never blocks, and the number of entries is bounded.

use std::collections::VecDeque;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

use super::faults::FaultKind;
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_core::sync::lock;

/// Maximum number of unread entries; newer ones are dropped.
const CAPACITY: usize = 256;

/// An event of an emulator.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SimEvent {
    /// A client connected; on a bus: the first frame arrived.
    Connected,
    /// A client disconnected, or was disconnected.
    Disconnected,
    /// Another client was rejected.
    Rejected,
    /// A client of another user was disconnected.
    Foreign,
    /// A fault of the script began.
    Fault(FaultKind),
}

static OPEN: AtomicBool = AtomicBool::new(false);
static ENTRIES: Mutex<VecDeque<(Mono, SimEvent)>> = Mutex::new(VecDeque::new());

/// Starts to record the events of all emulators of this program.
pub fn open() {
    lock(&ENTRIES).reserve(CAPACITY);
    OPEN.store(true, Ordering::Relaxed);
}

/// Records an event, if recording was started.
pub fn note(what: SimEvent) {
    if !OPEN.load(Ordering::Relaxed) {
        return;
    }
    let mut entries = lock(&ENTRIES);
    if entries.len() < CAPACITY {
        entries.push_back((MonotonicClock.now(), what));
    }
}

/// Removes and returns the oldest entry.
pub fn take() -> Option<(Mono, SimEvent)> {
    lock(&ENTRIES).pop_front()
}
