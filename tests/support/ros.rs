//! Nodes of ROS 2 that are none of our code, and their router, on this computer.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};

use serde_json::{Value, json};

use super::network::{free_port, is_built};
use super::program::{Home, Started, eventually};
use super::python::python_with;
use super::scripted::Scripted;

fn reader(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/readers").join(name)
}

/// A router; ends when dropped.
pub struct Router {
    child: Child,
    _to: ChildStdin,
}

impl Router {
    fn start(python: &Path, port: u16) -> Self {
        let mut command = Command::new(python);
        command.arg(reader("zenoh_router.py")).arg(port.to_string()).stderr(Stdio::null());
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let to = child.stdin.take().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        assert_eq!(line, "ready\n", "the router did not start");
        Self { child, _to: to }
    }
}

impl Drop for Router {
    fn drop(&mut self) {
        let _ = (self.child.kill(), self.child.wait());
    }
}

/// A computer with ROS 2.
pub struct Ros {
    python: PathBuf,
    /// Port of its router.
    pub port: u16,
}

impl Ros {
    /// Nothing where its packages are not installed, or this build has no network.
    #[track_caller]
    pub fn new(packages: &[&str]) -> Option<Self> {
        if !is_built() {
            return None;
        }
        let python = python_with(&[packages, &["zenoh", "rosbags", "numpy"]].concat())?;
        Some(Self { python, port: free_port() })
    }

    pub fn router(&self) -> Router {
        Router::start(&self.python, self.port)
    }

    /// A run that is a node there, once it serves. `more`: further keys of the section, each with a leading comma.
    #[track_caller]
    pub fn run(&self, blueprint: &str, more: &str) -> (Home, Started) {
        let (home, run) = self.run_alone(blueprint, more);
        eventually("the face serves", || home.status()["share"]["faces"][0]["serves"] == true);
        (home, run)
    }

    /// The same, also without a router.
    #[track_caller]
    pub fn run_alone(&self, blueprint: &str, more: &str) -> (Home, Started) {
        let home = Home::new();
        let face = format!("{{router: tcp/127.0.0.1:{}{more}}}", self.port);
        home.write("cell.yaml", &format!("{blueprint}share: {{ros: {face}}}\n"));
        let run = home.run("cell.yaml --no-record");
        (home, run)
    }

    /// What zenoh-ros2-sdk sees.
    #[track_caller]
    pub fn sdk(&self, home: &Home) -> Value {
        let mut command = Command::new(&self.python);
        command.arg(reader("ros2_sdk.py")).arg(self.port.to_string()).env("HOME", home.path());
        let output = command.stdin(Stdio::null()).output().unwrap();
        let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
        assert!(output.status.success(), "{out}\n{err}");
        serde_json::from_str(out.lines().last().unwrap_or_default()).unwrap_or_else(|e| panic!("{e}: {out}\n{err}"))
    }

    /// A client of services and actions. `more`: domain, distro, namespace.
    pub fn client(&self, more: Value) -> RosClient {
        let mut script = Scripted::start(Command::new(&self.python).arg(reader("ros2_client.py")));
        script.say(json!({"port": self.port}), more);
        RosClient(script)
    }
}

/// A client of services and actions of ROS 2.
pub struct RosClient(Scripted);

impl RosClient {
    /// Does what the script names so.
    #[track_caller]
    pub fn does(&mut self, what: &str, arguments: Value) -> Value {
        self.0.does(what, arguments)
    }

    /// Sends a goal to `traj_arm`; its number, or nothing if it is rejected. `more`: tolerances and the like.
    #[track_caller]
    pub fn goal(&mut self, points: Value, more: Value) -> Value {
        let joints: Vec<String> = (1..=6).map(|joint| format!("arm_joint{joint}")).collect();
        let mut goal = json!({"task": "traj_arm", "joints": joints, "points": points});
        goal.as_object_mut().unwrap().extend(more.as_object().cloned().unwrap_or_default());
        self.does("goal", goal)
    }

    /// Sends a goal; its state, code and text at its end.
    #[track_caller]
    pub fn goes(&mut self, points: Value, more: Value) -> Value {
        let goal = self.goal(points, more);
        assert!(goal.is_string(), "the goal was rejected");
        self.does("result", json!({"goal": goal}))
    }
}
