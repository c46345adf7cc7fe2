//! When the host of this virtual machine, or its kernel, let no program run on a processor: the only excuse of a soak.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};

use dimos::rt::host;
use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

/// Above every thread of a run.
const PRIORITY: i32 = 95;
/// Shorter stalls are not recorded.
const NOTED: Duration = Duration::from_millis(20);

/// A time without any program on a processor.
#[derive(Clone, Copy, Debug)]
pub struct HostStall {
    pub cpu: usize,
    pub ended: SystemTime,
    pub length: Duration,
}

/// One thread per processor, bound to it, that measures how late it wakes. With real-time permission nothing but the
/// kernel and the host can delay it.
pub struct HostStalls {
    found: Arc<Mutex<Vec<HostStall>>>,
    closing: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl HostStalls {
    pub fn watch() -> Self {
        let (found, closing) = (Arc::new(Mutex::new(Vec::new())), Arc::new(AtomicBool::new(false)));
        let allowed = sched_getaffinity(None).unwrap();
        let one = |cpu: usize| {
            let (found, closing) = (found.clone(), closing.clone());
            std::thread::spawn(move || {
                let mut only = CpuSet::new();
                only.set(cpu);
                sched_setaffinity(None, &only).unwrap();
                host::enter_realtime(PRIORITY);
                while !closing.load(Ordering::Relaxed) {
                    let began = Instant::now();
                    std::thread::sleep(Duration::from_millis(1));
                    let length = began.elapsed();
                    if length > NOTED {
                        found.lock().unwrap().push(HostStall { cpu, ended: SystemTime::now(), length });
                    }
                }
            })
        };
        let threads = (0..CpuSet::MAX_CPU).filter(|cpu| allowed.is_set(*cpu)).map(one).collect();
        Self { found, closing, threads }
    }

    /// All stalls of at least `length`.
    pub fn of(&self, length: Duration) -> Vec<HostStall> {
        self.found.lock().unwrap().iter().filter(|stall| stall.length >= length).copied().collect()
    }
}

impl Drop for HostStalls {
    fn drop(&mut self) {
        self.closing.store(true, Ordering::Relaxed);
        self.threads.drain(..).for_each(|thread| drop(thread.join()));
    }
}
