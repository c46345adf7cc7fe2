//! Starts, monitors and ends the tick thread of a run.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::Sender;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::{Ending, watchdog};
use dimos_control::config::CoordinatorConfig;
use dimos_control::coordinator::Coordinator;
use dimos_control::task::Task;
use dimos_control::tick_loop::{self, Probe, Pulse, TickPorts};
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_core::sync::panic_text;
use dimos_rt::host;

/// Timeout for the thread to end.
const END_LIMIT: Duration = Duration::from_millis(300);
/// Poll period while waiting for that.
const POLL_PERIOD: Duration = Duration::from_millis(1);

/// The running tick. Ends when dropped.
pub(in crate::runtime) struct Tick {
    pulse: Arc<Pulse>,
    period: Duration,
    thread: Option<JoinHandle<()>>,
}

impl Tick {
    /// Starts the thread `tick`. A panic in it is a fault that ends the run.
    pub fn start(
        config: &CoordinatorConfig,
        tasks: Vec<Task>,
        ports: TickPorts,
        probe: Option<Probe>,
        endings: Sender<Ending>,
    ) -> std::io::Result<Self> {
        let (coordinator, period, pulse) = (Coordinator::new(config, tasks), config.period(), ports.pulse.clone());
        let thread = std::thread::Builder::new().name("tick".into()).stack_size(host::STACK).spawn(move || {
            let ran = catch_unwind(AssertUnwindSafe(|| {
                tick_loop::run(coordinator, ports, period, &MonotonicClock, probe);
            }));
            if let Err(panic) = ran {
                let _ = endings.send(Ending::Fault(format!("the tick thread panicked: {}", panic_text(&*panic))));
            }
        })?;
        Ok(Self { pulse, period, thread: Some(thread) })
    }

    /// Returns whether it runs and its heartbeat is recent.
    pub fn is_alive(&self) -> bool {
        let silence = self.pulse.beat.silence(MonotonicClock.now());
        self.thread.as_ref().is_some_and(|thread| !thread.is_finished())
            && silence.is_none_or(|silence| silence < watchdog::tick_timeout(self.period))
    }

    /// Ends it after the current tick. Returns `false` if it hangs and was abandoned.
    pub fn end(&mut self) -> bool {
        self.pulse.stop.store(true, Ordering::Release);
        let limit = if self.is_alive() { END_LIMIT.max(2 * self.period) } else { Duration::ZERO };
        let Some(thread) = self.thread.take() else { return true };
        let began = Instant::now();
        while !thread.is_finished() && began.elapsed() < limit {
            std::thread::sleep(POLL_PERIOD);
        }
        let ended = thread.is_finished();
        if ended {
            // A panic was reported when it happened.
            let _ = thread.join();
        }
        ended
    }
}

impl Drop for Tick {
    fn drop(&mut self) {
        self.end();
    }
}
