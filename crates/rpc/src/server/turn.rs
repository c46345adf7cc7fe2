//! What one thread `rpc-stop` serves: another one ends it where the first hangs.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, Weak};

use rustix::net::Shutdown;
use tokio::net::UnixStream;
use tokio::sync::Semaphore;

use crate::server::stop_thread::Reception;
use dimos_core::sync::lock;

/// Maximum number of connections that have no permit yet, and of urgent requests that are answered without one.
pub(crate) const MAX_WITHOUT_PERMIT: usize = 256;

/// A connection, and the number of its permit.
type Connection = (Weak<UnixStream>, Option<u64>);

/// Life signs of one thread, and the connections that it serves.
#[derive(Debug)]
pub(crate) struct Turn {
    pub beats: AtomicU64,
    /// Another thread has taken its place.
    replaced: AtomicBool,
    /// Urgent requests that may still be answered without a permit.
    pub unbound: Semaphore,
    next: AtomicU64,
    served: Mutex<BTreeMap<u64, Connection>>,
}

impl Default for Turn {
    fn default() -> Self {
        Self {
            beats: AtomicU64::new(0),
            replaced: AtomicBool::new(false),
            unbound: Semaphore::new(MAX_WITHOUT_PERMIT),
            next: AtomicU64::new(0),
            served: Mutex::default(),
        }
    }
}

/// Lists a connection among those that a thread serves, until dropped.
pub(crate) struct Served<'a>(&'a Turn, u64);

impl Turn {
    /// Lists a connection with the number of its permit, if it has one, until the guard is dropped.
    pub fn serves(&self, stream: &Arc<UnixStream>, permit: Option<u64>) -> Served<'_> {
        let entry = self.next.fetch_add(1, Ordering::Relaxed);
        lock(&self.served).insert(entry, (Arc::downgrade(stream), permit));
        Served(self, entry)
    }

    /// Returns whether another thread has taken its place.
    pub fn is_replaced(&self) -> bool {
        self.replaced.load(Ordering::Relaxed)
    }

    /// Closes the connections that a hung thread serves: their clients can connect again.
    pub fn abandon(&self, reception: &Reception) {
        self.replaced.store(true, Ordering::Relaxed);
        for (stream, permit) in std::mem::take(&mut *lock(&self.served)).into_values() {
            if let Some(stream) = stream.upgrade() {
                let _ = rustix::net::shutdown(&*stream, Shutdown::Both);
            }
            if let Some(permit) = permit {
                reception.leases.end_connection(permit, Arc::default());
                reception.limit.end_connection(permit);
            }
        }
    }
}

impl Drop for Served<'_> {
    fn drop(&mut self) {
        lock(&self.0.served).remove(&self.1);
    }
}
