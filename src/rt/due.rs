//! When a thread means to be awake at the latest: one thread says so before it waits, others see that it is late.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use crate::clock::Mono;

/// A waiting thread's deadline.
#[derive(Debug, Default)]
pub struct Due(AtomicU64);

impl Due {
    /// The thread waits, until `at` at the latest.
    pub fn wait_until(&self, at: Mono) {
        self.0.store(at.0, Ordering::Release);
    }

    /// The thread is awake.
    pub fn awake(&self) {
        self.0.store(0, Ordering::Release);
    }

    /// How long ago a waiting thread should have been awake; zero while it is awake or its deadline is ahead.
    pub fn overdue(&self, now: Mono) -> Duration {
        match self.0.load(Ordering::Acquire) {
            0 => Duration::ZERO,
            due => now.since(Mono(due)),
        }
    }
}
