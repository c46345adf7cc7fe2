//! Checks that the tick is alive, from another thread. If the tick hangs, the device threads hold their arms on their
//! own; the watchdog ends the run.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Sender;
use std::thread::JoinHandle;
use std::time::Duration;

use super::Ending;
use crate::clock::{Clock, MonotonicClock};
use crate::rt::heartbeat::Heartbeat;
use crate::rt::host;

/// Period of the check: each one costs a wake-up of the processor.
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// Time without a tick after which it counts as hung: longer than stalls of the computer, short enough to end a run
/// within a second.
pub fn silence_limit(period: Duration) -> Duration {
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
            let limit = silence_limit(period);
            let (mut last, mut silent_for, mut looked) = (None, Duration::ZERO, MonotonicClock.now());
            while !stopping.load(Ordering::Acquire) {
                std::thread::park_timeout(LOOK_EVERY);
                let now = MonotonicClock.now();
                let beat = beat.last();
                // After SIGSTOP and SIGCONT there was no tick, but the tick could not run: only time counts in which
                // this thread could run.
                let passed = now.since(looked).min(2 * LOOK_EVERY);
                silent_for = if beat == last { silent_for + passed } else { Duration::ZERO };
                if beat != last {
                    alive();
                }
                (last, looked) = (beat, now);
                if beat.is_some() && silent_for > limit && !stopping.load(Ordering::Acquire) {
                    let what = format!("the tick has been silent for {} ms", silent_for.as_millis());
                    let _ = endings.send(Ending::Fault(what));
                    return;
                }
            }
        })?;
        Ok(Self { stop, thread: Some(thread) })
    }

    /// Ends the check: no further ticks are expected.
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
    fn a_sign_of_life_is_given_for_a_beat_and_for_nothing_else() {
        let (beat, signs, (endings, ended)) =
            (Arc::new(Heartbeat::default()), Arc::new(AtomicUsize::new(0)), channel());
        let given = signs.clone();
        let alive = move || {
            given.fetch_add(1, Ordering::Relaxed);
        };
        let _watchdog = Watchdog::start(beat.clone(), Duration::from_millis(10), endings, alive).unwrap();
        assert!(ended.recv_timeout(3 * LOOK_EVERY).is_err(), "before the first beat nothing is silent");
        assert_eq!(signs.load(Ordering::Relaxed), 0);
        beat.beat(MonotonicClock.now());
        assert!(matches!(ended.recv().unwrap(), Ending::Fault(what) if what.contains("silent")));
        assert_eq!(signs.load(Ordering::Relaxed), 1);
    }
}
