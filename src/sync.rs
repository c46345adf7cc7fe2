//! Locks of plain data.

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Locks. A holder that panicked leaves plain data behind, which is as good as before.
pub fn lock<T: ?Sized>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
