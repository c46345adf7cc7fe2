//! Heartbeat: one thread updates a timestamp, others check its age.

use std::sync::atomic::{AtomicI32, AtomicU64, Ordering};
use std::time::Duration;

use super::due::Due;
use super::host;
use dimos_core::clock::Mono;

/// The time of the latest beat, the earliest time at which the next one is due, and the thread that beats.
#[derive(Debug, Default)]
pub struct Heartbeat {
    last: AtomicU64,
    due: Due,
    /// Processor clock of the thread; 0: unknown.
    cpu_clock: AtomicI32,
    /// Id of the thread; 0: unknown.
    thread: AtomicI32,
}

impl Heartbeat {
    /// Makes the processor time of the calling thread known: it is the one that beats.
    pub fn adopt_thread(&self) {
        self.cpu_clock.store(host::cpu_clock().unwrap_or(0), Ordering::Release);
        self.thread.store(rustix::thread::gettid().as_raw_nonzero().get(), Ordering::Release);
    }

    /// Returns the processor time of the thread that beats; `None` if it is unknown or the thread has ended.
    pub fn cpu_time(&self) -> Option<Duration> {
        match self.cpu_clock.load(Ordering::Acquire) {
            0 => None,
            clock => host::cpu_time_of(clock),
        }
    }

    /// Returns whether the thread wants to run and got less than a third of a processor in the time `passed`, since its
    /// processor time was `used_before`. A thread that waits, also for a lock, or that a debugger has stopped, is not
    /// starved; nor is one in an endless loop, unless others keep it from the processor. Reads a file of /proc.
    pub fn is_starved(&self, used_before: Option<Duration>, passed: Duration) -> bool {
        let used = self.cpu_time().zip(used_before).map(|(now, before)| now.saturating_sub(before));
        used.is_some_and(|used| used < passed / 3) && self.is_runnable()
    }

    fn is_runnable(&self) -> bool {
        let file = format!("/proc/self/task/{}/stat", self.thread.load(Ordering::Acquire));
        let stat = std::fs::read_to_string(file).unwrap_or_default();
        // The name before it may have blanks and parentheses.
        stat.rsplit_once(')').is_some_and(|(_, rest)| rest.trim_start().starts_with('R'))
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
