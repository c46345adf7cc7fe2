//! The gateway that `dimos run` starts for a blueprint with a section `share`: in its own process, which ends with the
//! run, and is started again while the run continues.

use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::text_log::Terminal;
use crate::blueprint::share::ShareConfig;

/// First and longest pause before the gateway is started again.
const PAUSE: (Duration, Duration) = (Duration::from_millis(200), Duration::from_secs(5));
/// A gateway that lived this long failed for a new reason: the pauses begin with the first.
const LIVED: Duration = Duration::from_secs(10);
/// Period of the checks of the process.
const PERIOD: Duration = Duration::from_millis(50);

/// Time for a gateway to end after its run.
const END_TIMEOUT: Duration = Duration::from_millis(500);

/// The process of a run's gateway. Ends when dropped, or after the run.
#[derive(Debug)]
pub struct ShareChild {
    end: Option<SyncSender<()>>,
    run_ends: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl ShareChild {
    /// Starts the gateway of a run. The kernel ends the process when this thread ends, and so with the run.
    pub fn start(run: &str, config: &ShareConfig, terminal: Terminal) -> std::io::Result<Self> {
        let program = std::env::current_exe()?;
        let section = serde_json::to_string(config)?;
        let (end, ended) = sync_channel(0);
        let (run, run_ends) = (run.to_owned(), Arc::new(AtomicBool::new(false)));
        let ends = run_ends.clone();
        let thread = std::thread::Builder::new().name("share".into()).spawn(move || {
            let start = || {
                let mut command = Command::new(&program);
                command.args(["share", "--run", &run, "--config", &section]).stdin(Stdio::null()).stdout(Stdio::null());
                command.spawn()
            };
            keep(start, &ended, &ends, &terminal);
        })?;
        Ok(Self { end: Some(end), run_ends, thread: Some(thread) })
    }

    /// Notes that the run ends: its gateway says so to its clients when that is done, and ends.
    pub fn run_ends(&self) {
        self.run_ends.store(true, Ordering::Release);
    }
}

impl Drop for ShareChild {
    fn drop(&mut self) {
        self.end.take();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Keeps a process alive until `ended` is disconnected. With `run_ends` its end is expected.
fn keep(start: impl Fn() -> std::io::Result<Child>, ended: &Receiver<()>, run_ends: &AtomicBool, terminal: &Terminal) {
    let mut pause = PAUSE.0;
    loop {
        let began = Instant::now();
        let why = match start() {
            Ok(mut child) => match wait(&mut child, ended, run_ends) {
                Some(status) => status,
                None => return,
            },
            Err(e) => e.to_string(),
        };
        if run_ends.load(Ordering::Acquire) {
            return;
        }
        if began.elapsed() > LIVED {
            pause = PAUSE.0;
        }
        let again = pause.as_secs_f64();
        terminal.note(format_args!(
            "warning: the gateway to other computers ended ({why}); starting it again in {again} s"
        ));
        if ended.recv_timeout(pause) != Err(RecvTimeoutError::Timeout) {
            return;
        }
        pause = (pause * 2).min(PAUSE.1);
    }
}

/// Waits for the end of a process; `None`: it was to end, and has ended.
fn wait(child: &mut Child, ended: &Receiver<()>, run_ends: &AtomicBool) -> Option<String> {
    loop {
        if let Ok(Some(status)) = child.try_wait() {
            return Some(status.to_string());
        }
        if ended.recv_timeout(PERIOD) != Err(RecvTimeoutError::Timeout) {
            let began = Instant::now();
            while run_ends.load(Ordering::Acquire) && began.elapsed() < END_TIMEOUT {
                if let Ok(Some(_)) = child.try_wait() {
                    return None;
                }
                std::thread::sleep(Duration::from_millis(5));
            }
            let _ = child.kill();
            let _ = child.wait();
            return None;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicU32;

    use super::*;

    #[test]
    fn a_gateway_that_ends_is_started_again_and_ends_with_the_run() {
        let starts = AtomicU32::new(0);
        let (end, ended) = sync_channel(0);
        let terminal = Terminal::start().unwrap();
        let (counted, terminal) = (&starts, &terminal);
        std::thread::scope(|scope| {
            scope.spawn(move || {
                let start = || {
                    // The first one fails at once, the second one would stay.
                    let first = counted.fetch_add(1, Ordering::AcqRel) == 0;
                    Command::new(if first { "false" } else { "sleep" }).args((!first).then_some("60")).spawn()
                };
                keep(start, &ended, &AtomicBool::new(false), terminal);
            });
            let deadline = Instant::now() + Duration::from_secs(20);
            while starts.load(Ordering::Acquire) < 2 && Instant::now() < deadline {
                std::thread::sleep(PERIOD);
            }
            drop(end);
        });
        assert_eq!(starts.load(Ordering::Acquire), 2);
    }
}
