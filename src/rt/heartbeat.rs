//! Heartbeat: one thread updates a timestamp, others check its age.

use std::sync::atomic::{AtomicI32, AtomicU64, Ordering};
use std::time::Duration;

use super::due::Due;
use super::host;
use crate::clock::Mono;

/// The time of the latest beat, the earliest time at which the next one is due, and the thread that beats.
#[derive(Debug, Default)]
pub struct Heartbeat {
    last: AtomicU64,
    due: Due,
    /// Processor clock of the thread; 0: unknown.
    cpu_clock: AtomicI32,
}

impl Heartbeat {
    /// Makes the processor time of the calling thread known: it is the one that beats.
    pub fn adopt_thread(&self) {
        self.cpu_clock.store(host::cpu_clock().unwrap_or(0), Ordering::Release);
    }

    /// Returns the processor time of the thread that beats; `None` if it is unknown or the thread has ended.
    pub fn cpu_time(&self) -> Option<Duration> {
        match self.cpu_clock.load(Ordering::Acquire) {
            0 => None,
            clock => host::cpu_time_of(clock),
        }
    }

    /// Records a beat.
    pub fn beat(&self, now: Mono) {
        self.last.store(now.0, Ordering::Release);
    }

    /// Notes that the thread sleeps until `at`.
    pub fn sleep_until(&self, at: Mono) {
        self.due.wait_until(at);
    }

    /// Notes that the thread is awake.
    pub fn awake(&self) {
        self.due.awake();
    }

    /// Returns for how long a sleeping thread has been overdue: it got no processor. Zero for a thread that is awake,
    /// even if it does not beat.
    pub fn overdue(&self, now: Mono) -> Duration {
        self.due.overdue(now)
    }

    /// Returns the time of the latest beat; `None` before the first.
    pub fn last(&self) -> Option<Mono> {
        match self.last.load(Ordering::Acquire) {
            0 => None,
            last => Some(Mono(last)),
        }
    }

    /// Returns the time since the latest beat; `None` before the first.
    pub fn silence(&self, now: Mono) -> Option<Duration> {
        self.last().map(|last| now.since(last))
    }
}
