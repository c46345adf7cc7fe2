//! Waits for the effect of a tick or a device thread: the condition is checked after every tick and after every answer
//! of an arm, without polling.

use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use tokio::sync::watch;

use crate::runtime::service::Service;
use dimos_control::tick_loop::Pulse;

/// Maximum wait for a tick.
const TICK_LIMIT: Duration = Duration::from_secs(1);

/// Counts ticks and answers of arms, and wakes the requests that wait for them.
#[derive(Debug, Default)]
pub(in crate::runtime) struct Progress(watch::Sender<u64>);

impl Progress {
    /// Counts a tick, or an answer of an arm.
    pub fn made(&self) {
        self.0.send_modify(|count| *count = count.wrapping_add(1));
    }
}

/// A waiting request: while this exists, every tick wakes the outcome thread.
struct Waiting<'a>(&'a Pulse);

impl<'a> Waiting<'a> {
    fn begin(pulse: &'a Pulse) -> Self {
        pulse.waiting.fetch_add(1, Ordering::SeqCst);
        Self(pulse)
    }
}

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        self.0.waiting.fetch_sub(1, Ordering::SeqCst);
    }
}

impl Service {
    /// Waits until `look` returns `Some`. Calls it now, after every tick and every answer of an arm, and at least
    /// several times a second. Returns `None` at the `limit`.
    pub(in crate::runtime) async fn until<T>(&self, limit: Instant, mut look: impl FnMut() -> Option<T>) -> Option<T> {
        let mut progress = self.progress.0.subscribe();
        let _waiting = Waiting::begin(&self.parts.pulse);
        loop {
            if let Some(found) = look() {
                return Some(found);
            }
            if tokio::time::timeout_at(limit.into(), progress.changed()).await.is_err() {
                return look();
            }
        }
    }

    /// Waits for the end of the next tick to begin: it reads all that the arms have reported so far.
    pub(in crate::runtime) async fn next_tick(&self) {
        let pulse = &self.parts.pulse;
        let begun = pulse.begun.load(Ordering::SeqCst);
        let done = || (pulse.ticks.load(Ordering::Acquire) > begun).then_some(());
        self.until(Instant::now() + TICK_LIMIT, done).await;
    }
}
