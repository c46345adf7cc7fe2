//! `assets/ros2`, without ROS: its messages in the types and the encoding of rosbags, its goals with the real binary.

use std::process::{Command, Stdio};

use crate::support::program::{Home, Started};
use crate::support::python::python_with;

fn file(name: &str) -> String {
    std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(name).display().to_string()
}

#[test]
fn messages_are_those_of_ros_and_goals_end_as_they_should() {
    let Some(python) = python_with(&["rosbags", "numpy"]) else { return };
    let home = Home::new();
    let _run = home.run("yourarm-planner --no-record --set hardware.arm.options.sim.droop=0.002");
    let mut command = Command::new(python);
    command.arg(file("tests/python/try_ros2.py")).env("PYTHONPYCACHEPREFIX", home.path());
    command.env("PYTHONPATH", format!("{}:{}", file("assets/python"), file("assets/ros2")));
    let ended = Started::of(home.settle(&mut command).stdin(Stdio::null())).wait();
    assert!(ended.with(0).out.ends_with("all is as it says\n"));
}

/// Without `rclpy`, what the node calls of it is not known.
#[test]
fn mypy_accepts_the_node() {
    let Some(python) = python_with(&["mypy"]) else { return };
    let home = Home::new();
    let mut command = Command::new(python);
    command.args(["-m", "mypy", "--strict", "--ignore-missing-imports", "--python-version", "3.9"]);
    command.args(["--cache-dir", "mypy", "-p", "dimos_ros2"]);
    command.env("MYPYPATH", format!("{}:{}", file("assets/python"), file("assets/ros2")));
    Started::of(home.settle(&mut command).stdin(Stdio::null())).wait().with(0).shows(&["no issues found"]);
}
