//! The real binary as a user runs it: in a home folder per test, and killed when the test ends.

use std::io::Read;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Output, Stdio};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use dimos::rpc::api::{State, Status};
use dimos::rpc::client::Client;
use dimos::rpc::run_dir::RunDir;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

/// Timeout of every wait.
pub const TIMEOUT: Duration = Duration::from_secs(30);
/// The last line of the banner: the run is up.
pub const UP: &str = "Press Ctrl-C for a controlled stop.";

/// Where homes are. Those of the real-time tests are in memory: they judge time, not a disk. Beside busy processes a
/// kernel may store a log a minute late, and a process that waits for its disk does not end.
fn place() -> PathBuf {
    let exe = std::env::current_exe().unwrap();
    let is_realtime = exe.file_name().is_some_and(|name| name.to_string_lossy().starts_with("realtime-"));
    let memory = Path::new("/dev/shm");
    if is_realtime && memory.is_dir() { memory.to_owned() } else { std::env::temp_dir() }
}

/// A user's folders: sockets, logs, settings. They are a world for themselves: other runs are not visible.
pub struct Home(tempfile::TempDir);

impl Home {
    pub fn new() -> Self {
        let home = Self(tempfile::tempdir_in(place()).unwrap());
        ["run", "state", "config"].iter().for_each(|f| std::fs::create_dir(home.path().join(f)).unwrap());
        home
    }

    pub fn path(&self) -> &Path {
        self.0.path()
    }

    /// Gives a command this user's folders.
    pub fn settle<'c>(&self, command: &'c mut Command) -> &'c mut Command {
        command
            .env("HOME", self.path())
            .env("XDG_RUNTIME_DIR", self.path().join("run"))
            .env("DIMOS_WORLD", self.path().join("run"))
            .env("XDG_STATE_HOME", self.path().join("state"))
            .env("XDG_CACHE_HOME", self.path().join("cache"))
            .env("XDG_CONFIG_HOME", self.path().join("config"))
            .env("DIMOS_PYTHON", Path::new(env!("CARGO_MANIFEST_DIR")).join(".venv/bin/python"))
            .env_remove("DIMOS_BLUEPRINT_PATH")
            .env_remove("DIMOS_LOG")
            .current_dir(self.path())
    }

    /// A verb. Runs serve no live view: many run at a time, and few tests look at it.
    pub fn command(&self, arguments: &str) -> Command {
        match arguments.strip_prefix("run ") {
            Some(rest) => self.as_typed(&format!("run --no-view {rest}")),
            None => self.as_typed(arguments),
        }
    }

    /// A verb as a user types it.
    pub fn as_typed(&self, arguments: &str) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_dimos"));
        self.settle(command.args(arguments.split_whitespace()));
        command
    }

    /// Runs a verb to its end.
    #[track_caller]
    pub fn dimos(&self, arguments: &str) -> Ended {
        Started::of(self.command(arguments).stdin(Stdio::null())).wait()
    }

    /// Starts a verb without waiting for anything.
    pub fn start(&self, arguments: &str) -> Started {
        Started::of(self.command(arguments).stdin(Stdio::null()))
    }

    /// `dimos run …`, when it is up.
    #[track_caller]
    pub fn run(&self, arguments: &str) -> Started {
        let run = self.start(&format!("run {arguments}"));
        run.until(UP);
        run
    }

    /// Writes a file into the working folder.
    pub fn write(&self, name: &str, text: &str) {
        std::fs::write(self.path().join(name), text).unwrap();
    }

    pub fn runs(&self) -> RunDir {
        RunDir::closed(self.path().join("run/dimos"))
    }

    /// A connection to the only run.
    pub fn client(&self) -> Client {
        Client::find(&self.runs(), None).unwrap()
    }

    /// The logs, by name.
    pub fn logs(&self) -> Vec<PathBuf> {
        let mut logs: Vec<_> = std::fs::read_dir(self.path().join("state/dimos"))
            .map(|all| all.map(|e| e.unwrap().path()).collect())
            .unwrap_or_default();
        logs.retain(|path| path.extension().is_some_and(|e| e == "mcap"));
        logs.sort();
        logs
    }

    /// What `dimos status --json` prints of the only run, or of one that has crashed. Asks the run itself: most tests
    /// wait for something here, and a process each time would keep a processor busy.
    #[track_caller]
    pub fn status(&self) -> Value {
        let runs = self.runs().runs().unwrap();
        let asked = runs.first().and_then(|run| Client::connect(&run.name, &run.socket).ok()?.call(Status {}).ok());
        match asked {
            Some(report) => serde_json::to_value(report).unwrap(),
            None => self.dimos("status --json").with(0).json()[0].take(),
        }
    }

    /// Measured positions of an arm [rad].
    #[track_caller]
    pub fn positions(&self, arm: &str) -> Vec<f64> {
        let state = self.client().call(State {}).unwrap();
        let arm = state.arms.iter().find(|a| a.hardware_id == arm).unwrap();
        arm.joints.iter().map(|joint| joint.position.unwrap()).collect()
    }
}

type Text = Arc<Mutex<String>>;

fn lock(text: &Text) -> MutexGuard<'_, String> {
    text.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A process that is killed when it is dropped.
pub struct Started {
    child: Option<Child>,
    out: Text,
    err: Text,
    readers: Vec<JoinHandle<()>>,
}

impl Started {
    /// Starts a command and collects its output.
    pub fn of(command: &mut Command) -> Self {
        let mut started = Self::unheard(command.stdout(Stdio::piped()).stderr(Stdio::piped()));
        let child = started.child.as_mut().unwrap();
        let (out, err) = (child.stdout.take().unwrap(), child.stderr.take().unwrap());
        started.readers = vec![collect(out, &started.out), collect(err, &started.err)];
        started
    }

    /// Starts a command whose output goes where the command sends it.
    pub fn unheard(command: &mut Command) -> Self {
        Self { child: Some(command.spawn().unwrap()), out: Text::default(), err: Text::default(), readers: Vec::new() }
    }

    pub fn pid(&self) -> u32 {
        self.child.as_ref().unwrap().id()
    }

    pub fn out(&self) -> String {
        lock(&self.out).clone()
    }

    pub fn err(&self) -> String {
        lock(&self.err).clone()
    }

    pub fn stdin(&mut self) -> ChildStdin {
        self.child.as_mut().unwrap().stdin.take().unwrap()
    }

    /// Waits until stdout or stderr contains a text.
    #[track_caller]
    pub fn until(&self, text: &str) {
        let began = Instant::now();
        while !self.err().contains(text) && !self.out().contains(text) {
            assert!(began.elapsed() < TIMEOUT, "no {text:?} in\n{}{}", self.out(), self.err());
            // The text may have come between the check above and the end of the output.
            if self.over() && !self.err().contains(text) && !self.out().contains(text) {
                panic!("ended without {text:?}:\n{}{}", self.out(), self.err());
            }
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    /// Whether it has ended, or has closed its output.
    pub fn over(&self) -> bool {
        self.readers.iter().all(JoinHandle::is_finished)
    }

    pub fn signal(&self, signal: Signal) {
        kill_process(Pid::from_raw(self.pid() as i32).unwrap(), signal).unwrap();
    }

    /// Waits for its end.
    #[track_caller]
    pub fn wait(mut self) -> Ended {
        let (began, mut child) = (Instant::now(), self.child.take().unwrap());
        let status = loop {
            if let Some(status) = child.try_wait().unwrap() {
                break status;
            }
            if began.elapsed() > TIMEOUT {
                let _ = (child.kill(), child.wait());
                panic!("does not end\n{}{}", self.out(), self.err());
            }
            std::thread::sleep(Duration::from_millis(1));
        };
        let took = began.elapsed();
        self.readers.drain(..).for_each(|r| r.join().unwrap());
        Ended { code: status.code(), signal: status.signal(), out: self.out(), err: self.err(), took }
    }

    /// Sends a signal and waits for the end.
    #[track_caller]
    pub fn end(self, signal: Signal) -> Ended {
        self.signal(signal);
        self.wait()
    }
}

impl Drop for Started {
    fn drop(&mut self) {
        if let Some(mut child) = self.child.take() {
            let _ = (child.kill(), child.wait());
        }
    }
}

fn collect(mut from: impl Read + Send + 'static, into: &Text) -> JoinHandle<()> {
    let into = into.clone();
    std::thread::spawn(move || {
        let mut buffer = [0; 4096];
        while let Ok(n @ 1..) = from.read(&mut buffer) {
            lock(&into).push_str(&String::from_utf8_lossy(&buffer[..n]));
        }
    })
}

/// A process that has ended.
#[derive(Debug)]
pub struct Ended {
    pub code: Option<i32>,
    pub signal: Option<i32>,
    pub out: String,
    pub err: String,
    /// Duration of the wait for its end.
    pub took: Duration,
}

impl From<Output> for Ended {
    fn from(output: Output) -> Self {
        let text = |bytes| String::from_utf8(bytes).unwrap();
        let (code, signal) = (output.status.code(), output.status.signal());
        Self { code, signal, out: text(output.stdout), err: text(output.stderr), took: Duration::ZERO }
    }
}

impl Ended {
    #[track_caller]
    pub fn with(self, code: i32) -> Self {
        let (out, err, signal) = (&self.out, &self.err, self.signal);
        assert_eq!(self.code, Some(code), "signal {signal:?}\nstdout:\n{out}\nstderr:\n{err}");
        self
    }

    /// stdout contains all of these.
    #[track_caller]
    pub fn shows(self, parts: &[&str]) -> Self {
        parts.iter().for_each(|part| assert!(self.out.contains(part), "no {part:?} in\n{}", self.out));
        self
    }

    /// stderr contains all of these.
    #[track_caller]
    pub fn says(self, parts: &[&str]) -> Self {
        parts.iter().for_each(|part| assert!(self.err.contains(part), "no {part:?} in\n{}", self.err));
        self
    }

    #[track_caller]
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.out).unwrap_or_else(|e| panic!("{e}: {}", self.out))
    }
}

/// Waits until `what` holds.
#[track_caller]
pub fn eventually(what: &str, mut holds: impl FnMut() -> bool) {
    let began = Instant::now();
    while !holds() {
        assert!(began.elapsed() < TIMEOUT, "not within {TIMEOUT:?}: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}
