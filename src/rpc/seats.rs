//! The places of a run's connections: how many there are, and who makes room for whom.
//!
//! There are [`MAX_CONNECTIONS`] for everything, and [`RESERVED_CONNECTIONS`] more that take only the requests that
//! always get through. A connection that needs a place when all are taken gets that of the oldest idle one.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use tokio::sync::Notify;

use super::api::{MAX_CONNECTIONS, RESERVED_CONNECTIONS};
use super::error::{Code, RpcError};
use super::lease::Leases;
use crate::sync::lock;

/// The places of a run.
#[derive(Debug)]
pub(super) struct Seats {
    leases: Arc<Leases>,
    taken: Mutex<Taken>,
}

#[derive(Debug, Default)]
struct Taken {
    next: u64,
    seats: BTreeMap<u64, Arc<Shared>>,
}

/// What others may see of a connection.
#[derive(Debug)]
struct Shared {
    reserved: AtomicBool,
    /// It was asked to leave; its place is free already.
    leaving: AtomicBool,
    /// It subscribes, or is the planner.
    pinned: AtomicBool,
    /// Since when it waits for the next request; `None`: it is busy with one.
    idle: Mutex<Option<Instant>>,
    leave: Notify,
}

/// A connection's place, given back when this is dropped.
#[derive(Debug)]
pub(super) struct Seat {
    number: u64,
    seats: Arc<Seats>,
    shared: Arc<Shared>,
}

impl Seats {
    /// All places free. Holders of leases keep theirs.
    pub fn new(leases: Arc<Leases>) -> Arc<Self> {
        Arc::new(Self { leases, taken: Mutex::default() })
    }

    /// A place for a new connection, a reserved one where all others are taken.
    pub fn take(self: &Arc<Self>) -> Result<Seat, RpcError> {
        let mut taken = lock(&self.taken);
        let reserved = if taken.count(false) < MAX_CONNECTIONS {
            false
        } else if taken.count(true) < RESERVED_CONNECTIONS {
            true
        } else if self.make_room(&taken, false) {
            false
        } else if self.make_room(&taken, true) {
            true
        } else {
            let text = format!("all {MAX_CONNECTIONS} connections and {RESERVED_CONNECTIONS} reserved ones are busy");
            return Err(RpcError::new(Code::TooManyConnections, text).hint("try again"));
        };
        taken.next += 1;
        let number = taken.next;
        let shared = Arc::new(Shared {
            reserved: AtomicBool::new(reserved),
            leaving: AtomicBool::new(false),
            pinned: AtomicBool::new(false),
            idle: Mutex::new(Some(Instant::now())),
            leave: Notify::new(),
        });
        taken.seats.insert(number, shared.clone());
        Ok(Seat { number, seats: self.clone(), shared })
    }

    /// Asks the connection that has been idle for the longest time to leave: of the reserved ones, or of the others.
    /// `false`: none is idle, but for those that subscribe, plan or hold a lease.
    fn make_room(&self, taken: &Taken, reserved: bool) -> bool {
        let idle = |(number, seat): (&u64, &Arc<Shared>)| {
            let stays =
                seat.is(reserved).is_none() || seat.pinned.load(Ordering::Relaxed) || self.leases.holds(*number);
            if stays { None } else { lock(&seat.idle).map(|since| (since, seat.clone())) }
        };
        let Some((_, seat)) = taken.seats.iter().filter_map(idle).min_by_key(|(since, _)| *since) else { return false };
        seat.leaving.store(true, Ordering::Relaxed);
        seat.leave.notify_one();
        true
    }
}

impl Taken {
    fn count(&self, reserved: bool) -> usize {
        self.seats.values().filter(|seat| seat.is(reserved).is_some()).count()
    }
}

impl Shared {
    /// Something, where it counts among the reserved places or among the others.
    fn is(&self, reserved: bool) -> Option<()> {
        let counts = !self.leaving.load(Ordering::Relaxed) && self.reserved.load(Ordering::Relaxed) == reserved;
        counts.then_some(())
    }
}

impl Seat {
    /// A number that no other connection of the run has.
    pub fn number(&self) -> u64 {
        self.number
    }

    /// Whether it takes only the requests that always get through.
    pub fn is_reserved(&self) -> bool {
        self.shared.reserved.load(Ordering::Relaxed)
    }

    /// Makes a reserved place one for everything: a free one, or that of the oldest idle connection.
    pub fn promote(&self) -> Result<(), RpcError> {
        if !self.is_reserved() {
            return Ok(());
        }
        let taken = lock(&self.seats.taken);
        if taken.count(false) < MAX_CONNECTIONS || self.seats.make_room(&taken, false) {
            self.shared.reserved.store(false, Ordering::Relaxed);
            return Ok(());
        }
        let text = format!("all {MAX_CONNECTIONS} connections are taken, and none of them is idle");
        let hint = "close one, or ask several things over one connection; \
                    `dimos stop`, `cancel`, `status` and `down` get through all the same";
        Err(RpcError::new(Code::TooManyConnections, text).hint(hint))
    }

    /// The connection waits for its next request.
    pub fn rest(&self) {
        lock(&self.shared.idle).get_or_insert_with(Instant::now);
    }

    /// The connection has a request to answer.
    pub fn begin(&self) {
        *lock(&self.shared.idle) = None;
    }

    /// Whether the connection subscribes or is the planner, and keeps its place however long it is silent.
    pub fn pin(&self, stays: bool) {
        self.shared.pinned.store(stays, Ordering::Relaxed);
    }

    /// Waits until the connection must make room; what to tell its client then.
    pub async fn must_leave(&self) -> RpcError {
        self.shared.leave.notified().await;
        let text = "this connection was idle and was closed to make room for another";
        RpcError::new(Code::TooManyConnections, text).hint("connect again; close connections that are not needed")
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        lock(&self.seats.taken).seats.remove(&self.number);
    }
}

#[cfg(test)]
mod tests {
    use super::super::lease::Lessee;
    use super::*;

    fn left(seat: &Seat) -> bool {
        seat.shared.leaving.load(Ordering::Relaxed)
    }

    #[test]
    fn the_oldest_idle_connection_makes_room_and_those_that_are_needed_stay() {
        let leases = Arc::new(Leases::default());
        let seats = Seats::new(leases.clone());
        let all: Vec<Seat> = (0..MAX_CONNECTIONS).map(|_| seats.take().unwrap()).collect();
        let lessee = Lessee::new(leases, all[0].number(), None);
        lessee.take(&["arm".to_owned()]).unwrap();
        all[1].pin(true);
        all[2].begin();
        let reserved = seats.take().unwrap();
        assert!(
            reserved.is_reserved() && all.iter().all(|seat| !left(seat)),
            "a stop needs no place of another connection"
        );
        reserved.promote().unwrap();
        let gone: Vec<usize> = (0..all.len()).filter(|i| left(&all[*i])).collect();
        assert_eq!(gone, [3]);
        all.iter().chain([&reserved]).for_each(Seat::begin);
        let reserved = seats.take().unwrap();
        assert_eq!(reserved.promote().unwrap_err().code, Code::TooManyConnections);
        drop(all);
        reserved.promote().unwrap();
    }

    #[test]
    fn a_newcomer_finds_a_place_as_long_as_anyone_is_idle() {
        let seats = Seats::new(Arc::default());
        let all: Vec<Seat> = (0..MAX_CONNECTIONS).map(|_| seats.take().unwrap()).collect();
        let reserved: Vec<Seat> = (0..RESERVED_CONNECTIONS).map(|_| seats.take().unwrap()).collect();
        let next = seats.take().unwrap();
        assert!(!next.is_reserved() && left(&all[0]) && !left(&reserved[0]));
        all.iter().chain([&next]).for_each(Seat::begin);
        let last = seats.take().unwrap();
        assert!(last.is_reserved() && left(&reserved[0]));
        reserved.iter().chain([&last]).for_each(Seat::begin);
        assert_eq!(seats.take().unwrap_err().code, Code::TooManyConnections);
    }
}
