//! A heartbeat: one thread shows that it lives, others look.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use super::due::Due;
use crate::clock::Mono;

/// The time of the last sign of life, and when the next may be expected at the earliest.
#[derive(Debug, Default)]
pub struct Beat {
    last: AtomicU64,
    due: Due,
}

impl Beat {
    /// A sign of life.
    pub fn beat(&self, now: Mono) {
        self.last.store(now.0, Ordering::Release);
    }

    /// The thread sleeps, until `at` at the latest.
    pub fn sleep_until(&self, at: Mono) {
        self.due.wait_until(at);
    }

    /// The thread is awake.
    pub fn awake(&self) {
        self.due.awake();
    }

    /// How long ago a sleeping thread should have been awake: it is not to blame, it got no processor. Zero for one that is
    /// awake and gives no sign of life.
    pub fn overdue(&self, now: Mono) -> Duration {
        self.due.overdue(now)
    }

    /// When the last sign was; `None` before the first.
    pub fn last(&self) -> Option<Mono> {
        match self.last.load(Ordering::Acquire) {
            0 => None,
            last => Some(Mono(last)),
        }
    }

    /// How long ago the last sign was; `None` before the first.
    pub fn silence(&self, now: Mono) -> Option<Duration> {
        self.last().map(|last| now.since(last))
    }
}
