//! A heartbeat: one thread shows that it lives, others look.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use crate::clock::Mono;

/// The time of the last sign of life.
#[derive(Debug, Default)]
pub struct Beat(AtomicU64);

impl Beat {
    /// A sign of life.
    pub fn beat(&self, now: Mono) {
        self.0.store(now.0, Ordering::Release);
    }

    /// When the last sign was; `None` before the first.
    pub fn last(&self) -> Option<Mono> {
        match self.0.load(Ordering::Acquire) {
            0 => None,
            last => Some(Mono(last)),
        }
    }

    /// How long ago the last sign was; `None` before the first.
    pub fn silence(&self, now: Mono) -> Option<Duration> {
        self.last().map(|last| now.since(last))
    }
}
