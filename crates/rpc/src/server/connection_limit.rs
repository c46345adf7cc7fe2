//! Limits the connections of a run, and closes idle ones to make room.
//!
//! [`MAX_CONNECTIONS`] are for all requests, [`RESERVED_CONNECTIONS`] more only for the requests that always get
//! through. If all are in use, a new connection replaces the one that has been idle for the longest time.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use tokio::sync::Notify;

use crate::api::{MAX_CONNECTIONS, RESERVED_CONNECTIONS};
use crate::error::{Code, RpcError};
use crate::server::lease::Leases;
use dimos_core::sync::lock;

/// The connections of a run.
#[derive(Debug)]
pub(crate) struct ConnectionLimit {
    leases: Arc<Leases>,
    open: Mutex<Open>,
}

#[derive(Debug, Default)]
struct Open {
    next: u64,
    connections: BTreeMap<u64, Arc<Shared>>,
}

/// State of a connection that other connections read.
#[derive(Debug)]
struct Shared {
    reserved: AtomicBool,
    /// It is being closed to make room, and no longer counts.
    evicted: AtomicBool,
    /// It has a subscription or is the planner's: it is not closed to make room.
    pinned: AtomicBool,
    /// Since when it waits for the next request; `None` while it handles one.
    idle_since: Mutex<Option<Instant>>,
    eviction: Notify,
}

/// Permission for a connection to be open; returned when dropped.
#[derive(Debug)]
pub(crate) struct Permit {
    number: u64,
    limit: Arc<ConnectionLimit>,
    shared: Arc<Shared>,
}

impl ConnectionLimit {
    /// Creates a limit without connections. Connections that hold a lease are not closed to make room.
    pub fn new(leases: Arc<Leases>) -> Arc<Self> {
        Arc::new(Self { leases, open: Mutex::default() })
    }

    /// Returns a permit for a new connection; a reserved one if all others are in use. Fails if all connections are
    /// busy.
    pub fn acquire(self: &Arc<Self>) -> Result<Permit, RpcError> {
        let mut open = lock(&self.open);
        let reserved = if open.count(false) < MAX_CONNECTIONS {
            false
        } else if open.count(true) < RESERVED_CONNECTIONS {
            true
        } else if self.evict_idle(&open, false) {
            false
        } else if self.evict_idle(&open, true) {
            true
        } else {
            let text = format!("all {MAX_CONNECTIONS} connections and {RESERVED_CONNECTIONS} reserved ones are busy");
            return Err(RpcError::new(Code::TooManyConnections, text).hint("try again"));
        };
        open.next += 1;
        let number = open.next;
        let shared = Arc::new(Shared {
            reserved: AtomicBool::new(reserved),
            evicted: AtomicBool::new(false),
            pinned: AtomicBool::new(false),
            idle_since: Mutex::new(Some(Instant::now())),
            eviction: Notify::new(),
        });
        open.connections.insert(number, shared.clone());
        Ok(Permit { number, limit: self.clone(), shared })
    }

    /// Frees the place of a connection.
    pub fn end_connection(&self, number: u64) {
        lock(&self.open).connections.remove(&number);
    }

    /// Starts closing the connection that has been idle for the longest time, among the reserved or the other ones.
    /// Returns `false` if there is none; pinned connections and lease holders do not count as idle.
    fn evict_idle(&self, open: &Open, reserved: bool) -> bool {
        let idle = |(number, connection): (&u64, &Arc<Shared>)| {
            let stays = !connection.counts_as(reserved)
                || connection.pinned.load(Ordering::Relaxed)
                || self.leases.holds(*number);
            if stays { None } else { lock(&connection.idle_since).map(|since| (since, connection.clone())) }
        };
        let longest_idle = open.connections.iter().filter_map(idle).min_by_key(|(since, _)| *since);
        let Some((_, connection)) = longest_idle else { return false };
        connection.evicted.store(true, Ordering::Relaxed);
        connection.eviction.notify_one();
        true
    }
}

impl Open {
    fn count(&self, reserved: bool) -> usize {
        self.connections.values().filter(|connection| connection.counts_as(reserved)).count()
    }
}

impl Shared {
    /// Returns whether it counts among the reserved connections or, with `false`, among the others.
    fn counts_as(&self, reserved: bool) -> bool {
        !self.evicted.load(Ordering::Relaxed) && self.reserved.load(Ordering::Relaxed) == reserved
    }
}

impl Permit {
    /// Returns the connection's number, unique within the run.
    pub fn number(&self) -> u64 {
        self.number
    }

    /// Returns whether the connection is a reserved one.
    pub fn is_reserved(&self) -> bool {
        self.shared.reserved.load(Ordering::Relaxed)
    }

    /// Makes a reserved connection an ordinary one, closing an idle one if necessary. Fails if there is none.
    pub fn promote(&self) -> Result<(), RpcError> {
        if !self.is_reserved() {
            return Ok(());
        }
        let open = lock(&self.limit.open);
        if open.count(false) < MAX_CONNECTIONS || self.limit.evict_idle(&open, false) {
            self.shared.reserved.store(false, Ordering::Relaxed);
            return Ok(());
        }
        let text = format!("all {MAX_CONNECTIONS} connections are in use, and none is idle");
        let hint = "close one, or send several requests over one connection; \
                    `dimos stop`, `cancel`, `status` and `down` still get through";
        Err(RpcError::new(Code::TooManyConnections, text).hint(hint))
    }

    /// Marks the connection as waiting for its next request.
    pub fn set_idle(&self) {
        lock(&self.shared.idle_since).get_or_insert_with(Instant::now);
    }

    /// Marks the connection as handling a request.
    pub fn set_busy(&self) {
        *lock(&self.shared.idle_since) = None;
    }

    /// Sets whether the connection stays open however long it is silent.
    pub fn set_pinned(&self, pinned: bool) {
        self.shared.pinned.store(pinned, Ordering::Relaxed);
    }

    /// Waits until the connection must be closed to make room; returns the error to send to its client.
    pub async fn evicted(&self) -> RpcError {
        self.shared.eviction.notified().await;
        let text = "this connection was idle and was closed to make room for another";
        RpcError::new(Code::TooManyConnections, text).hint("connect again; close connections that are not needed")
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        self.limit.end_connection(self.number);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::server::lease::Lessee;

    fn is_evicted(permit: &Permit) -> bool {
        permit.shared.evicted.load(Ordering::Relaxed)
    }

    #[test]
    fn the_longest_idle_connection_is_closed_unless_it_is_pinned_busy_or_holds_a_lease() {
        let leases = Arc::new(Leases::default());
        let limit = ConnectionLimit::new(leases.clone());
        let all: Vec<Permit> = (0..MAX_CONNECTIONS).map(|_| limit.acquire().unwrap()).collect();
        let lessee = Lessee::new(leases, all[0].number(), Default::default());
        lessee.take(&["arm".to_owned()]).unwrap();
        all[1].set_pinned(true);
        all[2].set_busy();
        let reserved = limit.acquire().unwrap();
        assert!(reserved.is_reserved() && !all.iter().any(is_evicted), "a reserved connection closes no other");
        reserved.promote().unwrap();
        let closed: Vec<usize> = (0..all.len()).filter(|i| is_evicted(&all[*i])).collect();
        assert_eq!(closed, [3]);
        all.iter().chain([&reserved]).for_each(Permit::set_busy);
        let reserved = limit.acquire().unwrap();
        assert_eq!(reserved.promote().unwrap_err().code, Code::TooManyConnections);
        drop(all);
        reserved.promote().unwrap();
    }

    #[test]
    fn a_new_connection_is_refused_only_if_all_are_busy() {
        let limit = ConnectionLimit::new(Arc::default());
        let all: Vec<Permit> = (0..MAX_CONNECTIONS).map(|_| limit.acquire().unwrap()).collect();
        let reserved: Vec<Permit> = (0..RESERVED_CONNECTIONS).map(|_| limit.acquire().unwrap()).collect();
        let next = limit.acquire().unwrap();
        assert!(!next.is_reserved() && is_evicted(&all[0]) && !is_evicted(&reserved[0]));
        all.iter().chain([&next]).for_each(Permit::set_busy);
        let last = limit.acquire().unwrap();
        assert!(last.is_reserved() && is_evicted(&reserved[0]));
        reserved.iter().chain([&last]).for_each(Permit::set_busy);
        assert_eq!(limit.acquire().unwrap_err().code, Code::TooManyConnections);
    }
}
