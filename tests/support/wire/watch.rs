//! Whether this computer was stalled during a measurement.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};

use dimos::rt::host;
use rustix::thread::{CapabilitySet, CpuSet, capabilities, sched_getaffinity, sched_setaffinity, set_capabilities};

/// Above every thread of a run.
const ABOVE_ALL: i32 = 95;
/// Shorter delays are not recorded.
const SHORTEST: Duration = Duration::from_millis(2);
/// A shorter delay of this computer holds no arm (`docs/faults.md`, F32).
pub const HOLDS: Duration = Duration::from_millis(100);
/// Maximum repetitions of what such delays spoil.
const REPETITIONS: usize = 5;

/// A time in which a thread should have run and did not.
#[derive(Clone, Copy, Debug)]
pub struct Delay {
    pub began: Instant,
    /// By the wall clock, as logs have it.
    pub ended: SystemTime,
    pub length: Duration,
}

/// Threads that sleep for 1 ms in a loop, and record how late they wake.
pub struct Watch {
    delays: Arc<Mutex<Vec<Delay>>>,
    closing: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Watch {
    /// A thread at the priority of emulators.
    pub fn of_emulators() -> Self {
        let emulator = || {
            host::enter_realtime(host::EMULATOR_PRIORITY);
        };
        Self::start(vec![Box::new(emulator)])
    }

    /// An ordinary thread.
    pub fn of_programs() -> Self {
        Self::start(vec![Box::new(|| ())])
    }

    /// A thread on each processor, above all others: only the kernel, or the host of a virtual machine, delays it.
    pub fn of_processors() -> Self {
        let prepare = || {
            host::enter_realtime(ABOVE_ALL);
        };
        Self::start(on_each_processor(prepare))
    }

    /// A thread on each processor, with the slices of a run's timed threads and, like these, without the right to
    /// schedule in real time.
    pub fn of_ordinary_threads() -> Self {
        let prepare = || {
            let mut own = capabilities(None).unwrap();
            for set in [&mut own.effective, &mut own.permitted, &mut own.inheritable] {
                set.remove(CapabilitySet::SYS_NICE);
            }
            set_capabilities(None, own).unwrap();
            assert!(!host::enter_realtime(ABOVE_ALL), "a limit permits real-time scheduling");
        };
        Self::start(on_each_processor(prepare))
    }

    /// [`Watch::of_processors`] for all tests of this process, until it ends.
    pub fn shared() -> &'static Self {
        static SHARED: OnceLock<Watch> = OnceLock::new();
        SHARED.get_or_init(Self::of_processors)
    }

    fn start(preparations: Vec<Box<dyn Fn() + Send>>) -> Self {
        let (delays, closing) = (Arc::new(Mutex::new(Vec::new())), Arc::new(AtomicBool::new(false)));
        let one = |prepare: Box<dyn Fn() + Send>| {
            let (delays, closing) = (delays.clone(), closing.clone());
            std::thread::spawn(move || {
                prepare();
                while !closing.load(Ordering::Relaxed) {
                    let began = Instant::now();
                    std::thread::sleep(Duration::from_millis(1));
                    let length = began.elapsed();
                    if length >= SHORTEST {
                        delays.lock().unwrap().push(Delay { began, ended: SystemTime::now(), length });
                    }
                }
            })
        };
        let threads = preparations.into_iter().map(one).collect();
        Self { delays, closing, threads }
    }

    /// All delays of at least `length`.
    pub fn delays(&self, length: Duration) -> Vec<Delay> {
        self.delays.lock().unwrap().iter().filter(|delay| delay.length >= length).copied().collect()
    }

    /// The longest delay that ended after `from`.
    pub fn longest_since(&self, from: Instant) -> Duration {
        let delays = self.delays.lock().unwrap();
        let since = delays.iter().rev().take_while(|delay| delay.began + delay.length >= from);
        since.map(|delay| delay.length).max().unwrap_or_default()
    }

    /// The sum of the delays of at least `shortest` that ended after `from`, of all threads.
    pub fn lost_since(&self, from: Instant, shortest: Duration) -> Duration {
        let delays = self.delays.lock().unwrap();
        let since = delays.iter().rev().take_while(|delay| delay.began + delay.length >= from);
        since.map(|delay| delay.length).filter(|length| *length >= shortest).sum()
    }

    /// Returns the first success of `attempt`. A failure is final, and fails the test, unless a delay of at least
    /// [`HOLDS`] was recorded during that attempt: such an attempt is not judged, and is repeated.
    #[track_caller]
    pub fn unless_stalled<T>(&self, mut attempt: impl FnMut() -> Result<T, String>) -> T {
        for _ in 0..REPETITIONS {
            let began = Instant::now();
            let why = match attempt() {
                Ok(value) => return value,
                Err(why) => why,
            };
            let longest = self.longest_since(began);
            assert!(longest >= HOLDS, "{why}\n(longest delay of this computer: {longest:?})");
            println!("not judged, this computer was stalled for {longest:?}: {why}");
        }
        panic!("this computer was stalled in {REPETITIONS} attempts");
    }
}

/// The preparation of one thread for each processor: binds it, and calls `prepare`.
fn on_each_processor(prepare: fn()) -> Vec<Box<dyn Fn() + Send>> {
    let allowed = sched_getaffinity(None).unwrap();
    let bound = |cpu: usize| -> Box<dyn Fn() + Send> {
        Box::new(move || {
            let mut only = CpuSet::new();
            only.set(cpu);
            sched_setaffinity(None, &only).unwrap();
            prepare();
        })
    };
    (0..CpuSet::MAX_CPU).filter(|cpu| allowed.is_set(*cpu)).map(bound).collect()
}

impl Drop for Watch {
    fn drop(&mut self) {
        self.closing.store(true, Ordering::Relaxed);
        self.threads.drain(..).for_each(|thread| drop(thread.join()));
    }
}
