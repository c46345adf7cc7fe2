//! eclipse-zenoh as the other end: `tests/readers/zenoh_client.py`, and a router.

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use serde_json::{Value, json};

use crate::text;

/// A process of Python that is ended when it is dropped.
pub struct Judge {
    child: Child,
    to: ChildStdin,
    from: BufReader<ChildStdout>,
}

const ROUTER: &str = "
import json, sys, zenoh
config = zenoh.Config()
for key, value in json.loads(sys.argv[1]).items():
    config.insert_json5(key, json.dumps(value))
with zenoh.open(config):
    print('{}', flush=True)
    sys.stdin.read()
";

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).to_owned()
}

fn python() -> Result<Command, String> {
    let python = root().join(".venv/bin/python");
    let mut asked = Command::new(&python);
    match asked.args(["-c", "import zenoh"]).stderr(Stdio::null()).status() {
        Ok(status) if status.success() => Ok(Command::new(python)),
        _ => Err("eclipse-zenoh is not installed (make test-tools)".to_owned()),
    }
}

impl Judge {
    /// Opens a client of the run `bench` at a place.
    pub fn open(at: &str) -> Result<Self, String> {
        let mut command = python()?;
        let mut judge = Self::start(command.arg(root().join("tests/readers/zenoh_client.py")))?;
        judge.say(&json!({"at": at, "run": "bench", "user": "-"}))?;
        judge.does("announce", json!({}))?;
        Ok(judge)
    }

    /// Starts a router.
    pub fn router(at: &str) -> Result<Self, String> {
        let settings = json!({"mode": "router", "listen/endpoints": [at], "scouting/multicast/enabled": false});
        let mut command = python()?;
        let mut judge = Self::start(command.args(["-c", ROUTER, &settings.to_string()]))?;
        judge.read()?;
        Ok(judge)
    }

    fn start(command: &mut Command) -> Result<Self, String> {
        let pipes = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::null());
        let mut child = pipes.spawn().map_err(text)?;
        let (to, from) = (child.stdin.take().ok_or("no stdin")?, child.stdout.take().ok_or("no stdout")?);
        Ok(Self { child, to, from: BufReader::new(from) })
    }

    fn say(&mut self, command: &Value) -> Result<Value, String> {
        writeln!(self.to, "{command}").map_err(text)?;
        self.read()
    }

    fn read(&mut self) -> Result<Value, String> {
        let mut line = String::new();
        self.from.read_line(&mut line).map_err(text)?;
        serde_json::from_str(&line).map_err(|e| format!("eclipse-zenoh: {e}: {line:?}"))
    }

    /// Does what the script names so.
    pub fn does(&mut self, what: &str, arguments: Value) -> Result<Value, String> {
        let mut command = arguments;
        command["do"] = json!(what);
        self.say(&command)
    }
}

impl Drop for Judge {
    fn drop(&mut self) {
        let _ = (self.child.kill(), self.child.wait());
    }
}
