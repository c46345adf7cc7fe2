//! Real-time setup of the host: FIFO scheduling, locked memory, no deep idle states. Each is requested; a refusal is
//! reported with its fix and never stops a run. Reasons and figures are in `docs/realtime.md`.

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::time::Duration;

use dimos_core::clock::{Clock, Mono, MonotonicClock};

/// FIFO priority of the watchdog: above all that it watches.
pub const WATCHDOG_PRIORITY: i32 = 82;
/// FIFO priority of the device threads: above the tick, so that a command is written before the next one arrives.
pub const DEVICE_PRIORITY: i32 = 81;
/// FIFO priority of the tick.
pub const TICK_PRIORITY: i32 = 80;
/// FIFO priority of emulators: they replace controllers, which do not share this host's processors.
pub const EMULATOR_PRIORITY: i32 = 79;
/// FIFO priority of the thread that receives an operator's stop: below all threads that move arms, above everything
/// else.
pub const STOP_PRIORITY: i32 = 10;
/// Name of the scheduling grant.
pub const SCHEDULING: &str = "real-time scheduling";
/// Stack of a real-time thread [bytes].
pub const STACK: usize = 256 * 1024;

/// One request to the host and its result.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Grant {
    /// What was requested.
    pub what: &'static str,
    /// Whether it was granted.
    pub granted: bool,
    /// Details: what was granted, or why not.
    pub detail: String,
    /// The fix if it was refused; otherwise empty.
    pub remedy: &'static str,
}

const FIFO_REMEDY: &str = "allow it: add `@realtime - rtprio 95` to /etc/security/limits.d/ and yourself to that group, or `setcap cap_sys_nice,cap_ipc_lock+ep` on the binary";
const MEMLOCK_REMEDY: &str =
    "allow it: `@realtime - memlock unlimited` in /etc/security/limits.d/ (LimitMEMLOCK=infinity under systemd)";
const LATENCY_REMEDY: &str = "allow it: let your group write /dev/cpu_dma_latency by a udev rule, or run as root";

/// Keeps deep idle states disabled until dropped.
#[derive(Debug)]
pub struct LatencyHold(#[expect(dead_code, reason = "the kernel keeps the request while the file is open")] File);

/// Freed memory up to this size is kept [bytes].
#[cfg(target_env = "gnu")]
const KEPT_MEMORY: libc::c_int = 8 << 20;

/// Makes the allocator keep freed memory for its next use. By default glibc returns the end of the heap to the kernel
/// from 128 KiB on, and maps each larger piece again: a page fault for every 4 KiB of a plan, and every unmapping
/// interrupts all threads of the process, the tick too.
pub fn keep_freed_memory() {
    #[cfg(target_env = "gnu")]
    for option in [libc::M_TRIM_THRESHOLD, libc::M_MMAP_THRESHOLD] {
        // SAFETY: takes numbers only; a value that is refused changes nothing.
        unsafe { libc::mallopt(option, KEPT_MEMORY) };
    }
}

/// Requests all process-wide settings. Keep the returned hold for the duration of the run.
pub fn prepare_process(hold_latency: bool) -> (Vec<Grant>, Option<LatencyHold>) {
    keep_freed_memory();
    let mut grants = vec![probe_fifo(), lock_memory()];
    let hold = hold_latency.then(hold_cpu_latency);
    let kept = match hold {
        None => {
            let detail = "left enabled: the run does not request real time".to_owned();
            grants.push(Grant { what: "deep idle states disabled", granted: false, detail, remedy: "" });
            None
        }
        Some(Ok(file)) => {
            let detail = "/dev/cpu_dma_latency at 0 µs".to_owned();
            grants.push(Grant { what: "deep idle states disabled", granted: true, detail, remedy: "" });
            Some(file)
        }
        Some(Err(e)) => {
            let detail = format!("/dev/cpu_dma_latency: {e}");
            grants.push(Grant { what: "deep idle states disabled", granted: false, detail, remedy: LATENCY_REMEDY });
            None
        }
    };
    (grants, kept)
}

/// Tries FIFO on the calling thread and returns to the default class.
fn probe_fifo() -> Grant {
    match set_fifo(TICK_PRIORITY) {
        Ok(()) => {
            set_other();
            let detail = format!("SCHED_FIFO {TICK_PRIORITY}–{WATCHDOG_PRIORITY}");
            Grant { what: SCHEDULING, granted: true, detail, remedy: "" }
        }
        Err(e) => {
            let detail = format!("SCHED_FIFO refused: {e}");
            Grant { what: SCHEDULING, granted: false, detail, remedy: FIFO_REMEDY }
        }
    }
}

/// Switches the calling thread to the FIFO class.
pub fn set_fifo(priority: i32) -> io::Result<()> {
    // SAFETY: sched_param is plain data, zero is a valid value for it.
    let mut param: libc::sched_param = unsafe { std::mem::zeroed() };
    param.sched_priority = priority;
    // SAFETY: pid 0 is the calling thread; the pointer is valid for the call.
    match unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO | libc::SCHED_RESET_ON_FORK, &param) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

fn set_other() {
    // SAFETY: as in `set_fifo`.
    let param: libc::sched_param = unsafe { std::mem::zeroed() };
    // SAFETY: as in `set_fifo`; returning to the default class is always allowed.
    unsafe { libc::sched_setscheduler(0, libc::SCHED_OTHER, &param) };
}

/// The slice of processor time that ordinary timed threads ask for [ns], the shortest that Linux grants.
const SLICE: u64 = 100_000;

/// Lets an ordinary thread wait less for a processor: since Linux 6.12 a thread that asks for short slices is run the
/// sooner after it wakes. Needs no right; older kernels ignore it.
fn ask_for_short_slices() {
    const SIZE: libc::c_uint = size_of::<libc::sched_attr>() as libc::c_uint;
    // SAFETY: sched_attr is plain data, zero is a valid value for it.
    let mut attr: libc::sched_attr = unsafe { std::mem::zeroed() };
    attr.size = SIZE;
    // SAFETY: pid 0 is the calling thread; the kernel writes at most SIZE bytes.
    if unsafe { libc::syscall(libc::SYS_sched_getattr, 0, &mut attr, SIZE, 0) } != 0 {
        return;
    }
    attr.sched_runtime = SLICE;
    // SAFETY: the pointer is valid for the call; only the calling thread is concerned.
    unsafe { libc::syscall(libc::SYS_sched_setattr, 0, &attr, 0) };
}

/// Prepares the calling thread for timed work: FIFO if permitted, otherwise short slices and the shortest timer slack;
/// touches its stack and locks it as far as the limit allows, so that it causes no page faults later. Returns whether
/// it runs under FIFO.
pub fn enter_realtime(priority: i32) -> bool {
    let fifo = set_fifo(priority).is_ok();
    if !fifo {
        ask_for_short_slices();
    }
    // SAFETY: PR_SET_TIMERSLACK takes one integer and concerns the calling thread only.
    unsafe { libc::prctl(libc::PR_SET_TIMERSLACK, 1) };
    touch_stack();
    fifo
}

#[inline(never)]
fn touch_stack() {
    let mut pages = [0u8; STACK / 2];
    for byte in pages.iter_mut().step_by(4096) {
        *byte = 1;
    }
    lock_pages(&pages);
    std::hint::black_box(&mut pages);
}

/// Locks all memory of the process, but only if that cannot make a later allocation fail: locked virtual size counts
/// against the limit.
fn lock_memory() -> Grant {
    let what = "memory locked";
    if !may_lock_all() {
        let detail = "only rings and stacks, as far as the limit allows".to_owned();
        return Grant { what, granted: false, detail, remedy: MEMLOCK_REMEDY };
    }
    // SAFETY: takes flags only; affects the whole process and moves nothing.
    match unsafe { libc::mlockall(libc::MCL_CURRENT | libc::MCL_FUTURE | libc::MCL_ONFAULT) } {
        0 => Grant { what, granted: true, detail: "all, as it is touched".to_owned(), remedy: "" },
        _ => Grant { what, granted: false, detail: io::Error::last_os_error().to_string(), remedy: MEMLOCK_REMEDY },
    }
}

fn may_lock_all() -> bool {
    let limit = rustix::process::getrlimit(rustix::process::Resource::Memlock);
    limit.current.is_none() || has_capability(14)
}

/// Returns whether the process has an effective capability (14 = CAP_IPC_LOCK), as reported by the kernel.
fn has_capability(bit: u32) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("CapEff:"));
    line.and_then(|hex| u64::from_str_radix(hex.trim(), 16).ok()).is_some_and(|caps| caps & (1 << bit) != 0)
}

/// Locks the pages of a buffer, as far as the limit allows; for processes that may not lock everything.
pub fn lock_pages<T>(buffer: &[T]) {
    let length = size_of_val(buffer);
    // SAFETY: the range is that of a live slice; locking changes nothing visible to Rust.
    unsafe { libc::mlock2(buffer.as_ptr().cast(), length, libc::MLOCK_ONFAULT as libc::c_uint) };
}

fn hold_cpu_latency() -> io::Result<LatencyHold> {
    let mut file = OpenOptions::new().write(true).open("/dev/cpu_dma_latency")?;
    file.write_all(&0i32.to_ne_bytes())?;
    Ok(LatencyHold(file))
}

/// Sleeps until a time of the monotonic clock; returns at once if it is past.
pub fn sleep_until(deadline: Mono) {
    // The kernel treats a timer that is already due like any other, at the same cost.
    if MonotonicClock.now() >= deadline {
        return;
    }
    let at = rustix::time::Timespec {
        tv_sec: (deadline.0 / 1_000_000_000) as i64,
        tv_nsec: (deadline.0 % 1_000_000_000) as i64,
    };
    // Continues a sleep that a signal interrupted.
    while rustix::thread::clock_nanosleep_absolute(rustix::thread::ClockId::Monotonic, &at).is_err() {}
}

/// Returns the processor time of the calling thread.
pub fn thread_cpu_time() -> Duration {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    Duration::new(t.tv_sec as u64, t.tv_nsec as u32)
}

/// Returns the kernel's number of the calling thread's processor clock.
pub fn cpu_clock() -> Option<libc::clockid_t> {
    let mut clock = 0;
    // SAFETY: the thread exists, because it calls; the pointer is valid for the call.
    let error = unsafe { libc::pthread_getcpuclockid(libc::pthread_self(), &mut clock) };
    (error == 0).then_some(clock)
}

/// Returns the processor time of the thread with this clock; `None` once the thread has ended.
pub fn cpu_time_of(clock: libc::clockid_t) -> Option<Duration> {
    let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: the pointer is valid for the call; an unknown clock is an error.
    let error = unsafe { libc::clock_gettime(clock, &mut time) };
    (error == 0).then(|| Duration::new(time.tv_sec.unsigned_abs(), time.tv_nsec.unsigned_abs() as u32))
}

/// Sets an environment variable, if this process has one thread: others may read the environment meanwhile. Returns
/// whether it did.
pub fn set_variable(name: &str, value: &str) -> bool {
    let alone = std::fs::read_dir("/proc/self/task").is_ok_and(|threads| threads.count() == 1);
    if alone {
        // SAFETY: no other thread can read the environment.
        unsafe { std::env::set_var(name, value) }
    }
    alone
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_environment_of_several_threads_stays_as_it_is() {
        // The harness has a thread for each test, and one of its own.
        assert!(!set_variable("DIMOS_TEST_OF_A_VARIABLE", "1"));
        assert_eq!(std::env::var_os("DIMOS_TEST_OF_A_VARIABLE"), None);
    }

    #[test]
    fn the_cpu_time_of_another_thread_is_known_until_it_ends() {
        let (clocks, clock) = std::sync::mpsc::channel();
        let busy = std::thread::spawn(move || {
            while thread_cpu_time() < Duration::from_millis(5) {}
            clocks.send(cpu_clock().unwrap()).unwrap();
            std::thread::park();
        });
        let clock = clock.recv().unwrap();
        let time = cpu_time_of(clock).unwrap();
        assert!(time >= Duration::from_millis(5), "{time:?}");
        busy.thread().unpark();
        busy.join().unwrap();
        // The kernel says that a thread has ended shortly before it forgets its times.
        let limit = std::time::Instant::now() + Duration::from_secs(10);
        while cpu_time_of(clock).is_some() {
            assert!(std::time::Instant::now() < limit, "a thread that has ended has a processor time");
            std::thread::yield_now();
        }
    }

    #[test]
    fn an_ordinary_timed_thread_has_short_slices() {
        let slice = std::thread::spawn(|| {
            ask_for_short_slices();
            // SAFETY: as above.
            let mut attr: libc::sched_attr = unsafe { std::mem::zeroed() };
            let size = size_of::<libc::sched_attr>();
            // SAFETY: as above.
            assert_eq!(unsafe { libc::syscall(libc::SYS_sched_getattr, 0, &mut attr, size, 0) }, 0);
            attr.sched_runtime
        });
        let slice = slice.join().unwrap();
        let release = rustix::system::uname().release().to_string_lossy().into_owned();
        let mut numbers = release.split(|c: char| !c.is_ascii_digit()).map(|n| n.parse::<u32>().unwrap_or(0));
        if (numbers.next(), numbers.next()) >= (Some(6), Some(12)) {
            assert_eq!(slice, SLICE, "Linux {release}");
        } else {
            println!("SKIPPED: Linux {release} has no slices per thread");
        }
    }
}
