//! Monotonic time, passed in wherever it matters, so that tests and simulation run on a virtual clock.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use serde::{Deserialize, Serialize};

/// A point in monotonic time [ns since an arbitrary origin, the same for all threads of the process].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize)]
pub struct Mono(pub u64);

impl Mono {
    /// The earliest point in time; also means "never".
    pub const ZERO: Mono = Mono(0);

    /// Time since `earlier` [s]; negative when `earlier` is in fact later.
    pub fn seconds_since(self, earlier: Mono) -> f64 {
        if self >= earlier { (self.0 - earlier.0) as f64 * 1e-9 } else { -((earlier.0 - self.0) as f64 * 1e-9) }
    }

    /// Time since `earlier`, zero when `earlier` is in fact later.
    pub fn since(self, earlier: Mono) -> Duration {
        Duration::from_nanos(self.0.saturating_sub(earlier.0))
    }

    /// This point moved later by `d`.
    pub fn after(self, d: Duration) -> Mono {
        Mono(self.0.saturating_add(d.as_nanos().min(u64::MAX as u128) as u64))
    }

    /// This point moved earlier by `d`, not before the origin.
    pub fn before(self, d: Duration) -> Mono {
        Mono(self.0.saturating_sub(d.as_nanos().min(u64::MAX as u128) as u64))
    }
}

/// Where time comes from.
pub trait Clock: Send + Sync {
    /// The present time.
    fn now(&self) -> Mono;
}

/// The kernel's `CLOCK_MONOTONIC`: the clock of every real run.
#[derive(Debug, Clone, Copy, Default)]
pub struct MonotonicClock;

impl Clock for MonotonicClock {
    fn now(&self) -> Mono {
        let t = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
        Mono(t.tv_sec as u64 * 1_000_000_000 + t.tv_nsec as u64)
    }
}

/// A clock that advances only when it is set. Clones share their time.
#[derive(Debug, Clone, Default)]
pub struct VirtualClock(Arc<AtomicU64>);

impl VirtualClock {
    /// A clock that shows `start`.
    pub fn starting_at(start: Mono) -> Self {
        Self(Arc::new(AtomicU64::new(start.0)))
    }

    /// Moves the clock on by `d`.
    pub fn advance(&self, d: Duration) {
        self.0.fetch_add(d.as_nanos() as u64, Ordering::SeqCst);
    }
}

impl Clock for VirtualClock {
    fn now(&self) -> Mono {
        Mono(self.0.load(Ordering::SeqCst))
    }
}

/// Wall time now [ns since the Unix epoch].
pub fn wall_now() -> u64 {
    std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(0, |d| d.as_nanos() as u64)
}

/// The one offset between monotonic and wall time of a run, taken once at its start, so that a step of the
/// wall clock never shows up inside a log.
#[derive(Debug, Clone, Copy)]
pub struct WallOffset {
    mono: Mono,
    wall: u64,
}

impl WallOffset {
    /// Reads both clocks now.
    pub fn take(clock: &dyn Clock) -> Self {
        Self { mono: clock.now(), wall: wall_now() }
    }

    /// A known pair, for tests and readers of logs.
    pub fn of(mono: Mono, wall: u64) -> Self {
        Self { mono, wall }
    }

    /// Wall time of a monotonic point [ns since the Unix epoch].
    pub fn wall(&self, t: Mono) -> u64 {
        (self.wall as i128 + t.0 as i128 - self.mono.0 as i128).max(0) as u64
    }
}
