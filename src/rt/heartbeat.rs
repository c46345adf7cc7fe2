//! Heartbeat: one thread updates a timestamp, others check its age.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use crate::clock::Mono;

/// The time of the latest beat.
#[derive(Debug, Default)]
pub struct Heartbeat(AtomicU64);

impl Heartbeat {
    /// Records a beat.
    pub fn beat(&self, now: Mono) {
        self.0.store(now.0, Ordering::Release);
    }

    /// Returns the time of the latest beat; `None` before the first.
    pub fn last(&self) -> Option<Mono> {
        match self.0.load(Ordering::Acquire) {
            0 => None,
            last => Some(Mono(last)),
        }
    }

    /// Returns the time since the latest beat; `None` before the first.
    pub fn silence(&self, now: Mono) -> Option<Duration> {
        self.last().map(|last| now.since(last))
    }
}
