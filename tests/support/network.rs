//! Runs that are shared with other computers, here all the same one; and a client of them that is none of our code.

use std::net::TcpListener;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use serde_json::{Value, json};

use super::program::{Ended, Home, Started};
use super::python::python_with;
use super::scripted::Scripted;
use super::skip::skip;

/// A mock arm that is moved directly.
pub const CELL: &str = "
hardware:
  - {hardware_id: arm, joints: {prefix: arm, count: 6}, adapter_type: mock}
tasks:
  - {name: traj_arm, type: trajectory, joint_names: {hardware: arm}}
  - {name: velocity_arm, type: velocity, joint_names: {hardware: arm}, priority: 20}
";

/// Whether this build reaches other computers; says so if not.
#[track_caller]
pub fn is_built() -> bool {
    if !cfg!(feature = "share") {
        skip("feature share (cargo test --features share)");
    }
    cfg!(feature = "share")
}

/// A port that nothing listens on.
pub fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

/// A run that is shared on the loopback interface without encryption.
pub struct Shared {
    pub home: Home,
    pub run: Started,
    pub at: String,
}

impl Shared {
    /// `more`: further keys of the section `share`, each with a leading comma.
    #[track_caller]
    pub fn start(more: &str) -> Self {
        Self::of(CELL, more)
    }

    #[track_caller]
    pub fn of(blueprint: &str, more: &str) -> Self {
        let (home, at) = (Home::new(), format!("tcp/127.0.0.1:{}", free_port()));
        home.write("cell.yaml", &format!("{blueprint}share: {{listen: [{at}]{more}}}\n"));
        let run = home.run("cell.yaml --no-record");
        let shared = Self { home, run, at };
        shared.until_shared();
        shared
    }

    /// Waits until clients find the run.
    pub fn until_shared(&self) {
        super::program::eventually("the run is shared", || self.gateway().is_some());
    }

    /// Process of the gateway.
    pub fn gateway(&self) -> Option<i32> {
        self.home.status()["share"]["pid"].as_i64().map(|pid| pid as i32)
    }

    /// A verb on another computer.
    pub fn command(&self, arguments: &str) -> Command {
        self.home.as_typed(&format!("--at {} {arguments}", self.at))
    }

    /// Runs a verb on another computer to its end.
    #[track_caller]
    pub fn there(&self, arguments: &str) -> Ended {
        Started::of(self.command(arguments).stdin(Stdio::null())).wait()
    }

    /// Who holds the lease of the arm.
    pub fn commander(&self) -> Option<String> {
        self.home.status()["arms"][0]["commander"]["program"].as_str().map(str::to_owned)
    }
}

/// eclipse-zenoh, driven by `tests/readers/zenoh_client.py`.
pub struct Judge {
    script: Scripted,
    /// What it answered first: its id, or why it was refused.
    pub opened: Value,
}

impl Judge {
    /// Opens a session as this user; nothing where eclipse-zenoh is not installed. `more`: files for TLS.
    #[track_caller]
    pub fn open(at: &str, user: &str, more: Value) -> Option<Self> {
        let python = python_with(&["zenoh"])?;
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/readers/zenoh_client.py");
        let mut script = Scripted::start(Command::new(python).arg(script).stderr(Stdio::null()));
        let opened = script.say(json!({"at": at, "run": "cell", "user": user}), more);
        Some(Self { script, opened })
    }

    /// Does what the script names so.
    #[track_caller]
    pub fn does(&mut self, what: &str, arguments: Value) -> Value {
        self.script.does(what, arguments)
    }

    /// Sends a request; what came back.
    #[track_caller]
    pub fn asks(&mut self, class: &str, method: &str, params: Value) -> Value {
        self.does("ask", json!({"cls": class, "method": method, "params": params}))
    }

    /// Sends a request that is not expected to be answered.
    #[track_caller]
    pub fn asks_shortly(&mut self, class: &str, method: &str) -> Value {
        self.does("ask", json!({"cls": class, "method": method, "timeout": 1.0}))
    }

    pub fn pid(&self) -> u32 {
        self.script.pid()
    }
}

/// Longest time for what happens at once: between two reads of a run, on a computer that is busy with other tests.
pub const AT_ONCE: Duration = Duration::from_millis(500);
