//! What happens to an emulator: clients that come and go, faults that strike. Nobody reads it unless it was opened, as
//! `dimos adapter emulate` does; whoever writes neither waits for a terminal nor makes the events grow without bound.

use std::collections::VecDeque;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

use super::faults::FaultKind;
use crate::clock::{Clock, Mono, MonotonicClock};
use crate::sync::lock;

/// So many entries wait for a reader; newer ones are then lost.
const CAPACITY: usize = 256;

/// Something that happened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SimEvent {
    /// A client connected; on a bus: the first frame came.
    Connected,
    /// A client has gone, or was cut off.
    Disconnected,
    /// Another client was turned away.
    Rejected,
    /// A fault of the script struck, for the first time.
    Fault(FaultKind),
}

static OPEN: AtomicBool = AtomicBool::new(false);
static ENTRIES: Mutex<VecDeque<(Mono, SimEvent)>> = Mutex::new(VecDeque::new());

/// From now on everything is noted that happens to emulators of this program.
pub fn open() {
    lock(&ENTRIES).reserve(CAPACITY);
    OPEN.store(true, Ordering::Relaxed);
}

/// Notes something, where the events is open.
pub fn note(what: SimEvent) {
    if !OPEN.load(Ordering::Relaxed) {
        return;
    }
    let mut entries = lock(&ENTRIES);
    if entries.len() < CAPACITY {
        entries.push_back((MonotonicClock.now(), what));
    }
}

/// Takes out the oldest entry.
pub fn take() -> Option<(Mono, SimEvent)> {
    lock(&ENTRIES).pop_front()
}
