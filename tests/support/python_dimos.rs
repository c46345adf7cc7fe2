//! Python dimos itself, driven by `tests/readers/python_dimos.py`, on a bus of the test's own: sessions find each other
//! by multicast on `lo`, and those of different groups never do.

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use serde_json::Value;

use super::network::free_port;
use super::program::{Home, Started};
use super::python::python_with;

/// A bus.
pub struct Bus {
    python: PathBuf,
    home: tempfile::TempDir,
    /// Its multicast group: `224.0.0.224:50123`.
    pub group: String,
}

impl Bus {
    /// A new bus; nothing where Python dimos is not installed.
    #[track_caller]
    pub fn new() -> Option<Self> {
        let python = python_with(&["dimos", "dimos_lcm", "zenoh"])?;
        let (home, group) = (tempfile::tempdir().unwrap(), format!("224.0.0.224:{}", free_port()));
        Some(Self { python, home, group })
    }

    fn command(&self, arguments: &str) -> Command {
        let mut command = Command::new(&self.python);
        command
            .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/readers/python_dimos.py"))
            .args(arguments.split_whitespace())
            .env("HOME", self.home.path())
            .env("XDG_STATE_HOME", self.home.path())
            .env("ZENOH_SCOUT_ADDR", &self.group)
            .env_remove("DIMOS_TRANSPORT")
            .current_dir(self.home.path())
            .stderr(Stdio::null())
            .stdout(Stdio::piped());
        command
    }

    /// Runs a mode of the script to its end; what it printed.
    #[track_caller]
    pub fn does(&self, mode: &str) -> Value {
        self.says(mode, "").pop().unwrap_or_else(|| panic!("{mode} printed nothing"))
    }

    /// Runs a mode of the script with this input.
    #[track_caller]
    pub fn says(&self, mode: &str, input: &str) -> Vec<Value> {
        let mut child = self.command(mode).stdin(Stdio::piped()).spawn().unwrap();
        child.stdin.take().unwrap().write_all(input.as_bytes()).unwrap();
        let output = child.wait_with_output().unwrap();
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(output.status.success(), "{mode}: {}\n{text}", output.status);
        text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
    }

    /// Starts their own coordinator, with an arm of six joints in memory.
    #[track_caller]
    pub fn coordinator(&self) -> Coordinator {
        let mut child = self.command("serve").stdin(Stdio::piped()).spawn().unwrap();
        let (to, from) = (child.stdin.take(), BufReader::new(child.stdout.take().unwrap()));
        let mut coordinator = Coordinator { child, to, from };
        coordinator.next();
        coordinator
    }

    /// Starts the bridge to a run of this user.
    pub fn bridge(&self, home: &Home, options: &str) -> Started {
        let mut command = Command::new(&self.python);
        home.settle(command.args(["-m", "dimos_client.python_dimos"]).args(options.split_whitespace()));
        command
            .env("PYTHONPATH", Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/python"))
            .env("PYTHONPYCACHEPREFIX", home.path())
            .env("ZENOH_SCOUT_ADDR", &self.group)
            .env_remove("DIMOS_TRANSPORT")
            .stdin(Stdio::null());
        Started::of(&mut command)
    }
}

/// Their own coordinator.
pub struct Coordinator {
    child: Child,
    to: Option<ChildStdin>,
    from: BufReader<ChildStdout>,
}

impl Coordinator {
    fn next(&mut self) -> Value {
        let mut line = String::new();
        while self.from.read_line(&mut line).unwrap() > 0 {
            if let Ok(value) = serde_json::from_str(&line) {
                return value;
            }
            line.clear();
        }
        panic!("their coordinator has ended");
    }

    /// Ends it; what it printed last: its positions, and the state of its newest motion.
    pub fn end(mut self) -> Value {
        self.to.take();
        self.next()
    }
}

impl Drop for Coordinator {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
