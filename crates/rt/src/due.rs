//! Wake deadline: a thread publishes it before it waits, others check whether the thread is late.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use dimos_core::clock::Mono;

/// The wake deadline of a waiting thread.
#[derive(Debug, Default)]
pub struct Due(AtomicU64);

impl Due {
    /// Marks the thread as waiting, until `at` at the latest.
    pub fn wait_until(&self, at: Mono) {
        self.0.store(at.0, Ordering::Release);
    }

    /// Marks the thread as awake.
    pub fn awake(&self) {
        self.0.store(0, Ordering::Release);
    }

    /// Returns how late a waiting thread is; zero while it is awake or its deadline is in the future.
    pub fn overdue(&self, now: Mono) -> Duration {
        match self.0.load(Ordering::Acquire) {
            0 => Duration::ZERO,
            due => now.since(Mono(due)),
        }
    }
}
