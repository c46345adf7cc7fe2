//! Every public method of the vendor's client (`tests/python/xarm_walk.py`), against the emulator and against
//! `dimos proxy xarm`: a call that returns 0 has changed what it names, or is a query with right values.

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Command, Stdio};

use dimos::rpc::api::State;
use serde_json::{Value, json};

use crate::support::python::python_with;
use crate::xarm_proxy::Cell;
use crate::xarm_sdk::emulator;

/// Runs the walk to its end, and answers its questions for the truth.
#[track_caller]
fn walk(python: &Path, what: &str, host: &str, mut truth: impl FnMut() -> Value) {
    let home = tempfile::tempdir().unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/xarm_walk.py");
    let mut command = Command::new(python);
    command.arg(script).args([what, host]).env("HOME", home.path()).env("PYTHONDONTWRITEBYTECODE", "1");
    let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let (mut to, mut said) = (child.stdin.take().unwrap(), String::new());
    for line in BufReader::new(child.stdout.take().unwrap()).lines().map_while(Result::ok) {
        match line.as_str() {
            "truth?" => writeln!(to, "{}", truth()).unwrap(),
            _ => said += &format!("{line}\n"),
        }
    }
    let ended = child.wait().unwrap();
    let results: Vec<&str> =
        said.lines().filter(|l| l.starts_with("FAILED") || l.contains("return 0") || l.contains("raised")).collect();
    println!("{}", results.join("\n"));
    assert!(ended.success() && said.ends_with("all is as it should be\n"), "{ended}\n{said}");
}

#[test]
fn no_call_of_the_vendors_client_succeeds_without_effect_on_the_emulator() {
    let Some((emulator, host)) = emulator(40, 6, json!({"gripper": "xarm", "force_torque": true})) else { return };
    let Some(python) = python_with(&["xarm"]) else { return };
    walk(
        &python,
        "emulator",
        &host,
        || json!({"joints": emulator.joints().0[..6], "motors": emulator.enabled(), "gripper": emulator.gripper()}),
    );
}

#[test]
fn no_call_of_the_vendors_client_succeeds_without_effect_in_the_proxy() {
    let Some(cell) = Cell::start("coordinator-xarm6", "--no-record") else { return };
    let mut client = cell.home.client();
    walk(&cell.python, "proxy", &cell.host, || {
        let state = client.call(State {}).unwrap();
        let arm = &state.arms[0];
        let joints: Vec<f64> = arm.joints.iter().filter_map(|joint| joint.position).collect();
        let status = cell.home.status();
        json!({"joints": joints, "motors": status["arms"][0]["enabled"], "gripper": arm.gripper})
    });
    let told = cell.proxy.err();
    for line in [
        "move_circle (register 27) refused (code 10): a run has no circles",
        "refused (code 10): a run has no absolute Cartesian moves here",
        "set_simulation_robot (register 79) refused (code 10)",
    ] {
        assert!(told.contains(line), "{line} is not in\n{told}");
    }
}
