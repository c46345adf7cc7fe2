//! Checks that the tick is alive, from another thread. If the tick hangs, the device threads hold their arms on their
//! own; the watchdog ends the run. A tick that only gets no processor does not hang: its arms are held, and it
//! continues.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Sender;
use std::thread::JoinHandle;
use std::time::Duration;

use super::Ending;
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_rt::heartbeat::Heartbeat;
use dimos_rt::host;

/// Period of the check: each one costs a wake-up of the processor.
const CHECK_PERIOD: Duration = Duration::from_millis(100);

/// Returns the time without a tick after which the tick counts as hung: longer than usual stalls of the host, short
/// enough to end a run within a second.
pub fn tick_timeout(period: Duration) -> Duration {
    (5 * period).max(Duration::from_millis(400))
}

/// The running watchdog. Ends when dropped.
pub struct Watchdog {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Watchdog {
    /// Starts the thread `watchdog`. `alive` is called at each check that finds a new tick, and must not block.
    pub fn start(
        beat: Arc<Heartbeat>,
        period: Duration,
        endings: Sender<Ending>,
        mut alive: impl FnMut() + Send + 'static,
    ) -> std::io::Result<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let stopping = stop.clone();
        let thread = std::thread::Builder::new().name("watchdog".into()).stack_size(host::STACK).spawn(move || {
            host::enter_realtime(host::WATCHDOG_PRIORITY);
            let limit = tick_timeout(period);
            let (mut last, mut silent_for, mut checked) = (None, Duration::ZERO, MonotonicClock.now());
            let mut used = None;
            while !stopping.load(Ordering::Acquire) {
                std::thread::park_timeout(CHECK_PERIOD);
                let now = MonotonicClock.now();
                let (latest, used_before) = (beat.last(), std::mem::replace(&mut used, beat.cpu_time()));
                // Counts only the time in which this thread could run: a SIGSTOP also stops the tick.
                let passed = now.since(checked).min(2 * CHECK_PERIOD);
                if latest != last {
                    silent_for = Duration::ZERO;
                    alive();
                } else if !beat.is_starved(used_before, passed) {
                    silent_for += passed;
                }
                (last, checked) = (latest, now);
                if latest.is_some() && silent_for > limit && !stopping.load(Ordering::Acquire) {
                    let what = format!("no tick for {} ms (limit {} ms)", silent_for.as_millis(), limit.as_millis());
                    let _ = endings.send(Ending::Fault(what));
                    return;
                }
            }
        })?;
        Ok(Self { stop, thread: Some(thread) })
    }

    /// Ends the checks: no further ticks are expected.
    pub fn stand_down(&self) {
        self.stop.store(true, Ordering::Release);
    }
}

impl Drop for Watchdog {
    fn drop(&mut self) {
        self.stand_down();
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicUsize;
    use std::sync::mpsc::channel;

    use super::*;

    #[test]
    fn watchdog_pings_only_while_ticks_arrive() {
        let (beat, pings, (endings, ended)) =
            (Arc::new(Heartbeat::default()), Arc::new(AtomicUsize::new(0)), channel());
        let counted = pings.clone();
        let alive = move || {
            counted.fetch_add(1, Ordering::Relaxed);
        };
        let _watchdog = Watchdog::start(beat.clone(), Duration::from_millis(10), endings, alive).unwrap();
        assert!(ended.recv_timeout(3 * CHECK_PERIOD).is_err(), "no fault before the first beat");
        assert_eq!(pings.load(Ordering::Relaxed), 0);
        beat.beat(MonotonicClock.now());
        assert!(matches!(ended.recv().unwrap(), Ending::Fault(what) if what.contains("no tick for")));
        assert_eq!(pings.load(Ordering::Relaxed), 1);
    }
}
