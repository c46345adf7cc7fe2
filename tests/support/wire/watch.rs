//! Whether this computer was stalled during a measurement.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use dimos::rt::host;

/// A thread that notices when it gets no processor.
pub struct Watch {
    longest: Arc<AtomicU64>,
    closing: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Watch {
    /// At the priority of emulators, or of any program.
    pub fn start(realtime: bool) -> Self {
        let (longest, closing) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicBool::new(false)));
        let (max, end) = (longest.clone(), closing.clone());
        let thread = std::thread::spawn(move || {
            if realtime {
                host::enter_realtime(host::EMULATOR_PRIORITY);
            }
            while !end.load(Ordering::Relaxed) {
                let began = Instant::now();
                std::thread::sleep(Duration::from_millis(1));
                max.fetch_max(
                    began.elapsed().saturating_sub(Duration::from_millis(1)).as_micros() as u64,
                    Ordering::Relaxed,
                );
            }
        });
        Self { longest, closing, thread: Some(thread) }
    }

    /// The longest time without a processor since this was last asked.
    pub fn stood_still(&self) -> Duration {
        Duration::from_micros(self.longest.swap(0, Ordering::Relaxed))
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        self.closing.store(true, Ordering::Relaxed);
        drop(self.thread.take().map(JoinHandle::join));
    }
}
