//! `ur_rtde`, a client of Universal Robots' controllers that others wrote: it commands the emulated arm, and its bytes
//! are the adapter's.

use std::path::Path;
use std::process::{Command, Stdio};

use dimos::arms::ur::protocol::rtde::{VERSION, encode, kind, recipe};

use crate::support::program::Home;
use crate::support::python::python_with;

/// Runs `tests/python/ur_rtde_client.py` with an emulator at this loopback address; `None` where `ur_rtde` is not
/// installed.
fn client(what: &str, address: &str) -> Option<String> {
    let python = python_with(&["rtde_control", "rtde_receive", "rtde_io", "dashboard_client"])?;
    let home = Home::new();
    let emulator = home.start(&format!("adapter emulate ur --bind {address}"));
    emulator.until("Ctrl-C ends it");
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/ur_rtde_client.py");
    let mut command = Command::new(python);
    let output =
        command.arg(script).args([what, address]).env("PYTHONDONTWRITEBYTECODE", "1").stdin(Stdio::null()).output();
    let output = output.unwrap();
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{out}\n{err}\n{}", emulator.err());
    Some(out.into_owned())
}

#[test]
fn ur_rtde_commands_the_emulated_arm() {
    let Some(said) = client("use", "127.48.17.5") else { return };
    assert!(said.ends_with("all is as it says\n"), "{said}");
}

/// Four clients end without disconnecting; what the emulated controller does not do is no success.
#[test]
fn clients_that_vanish_and_commands_that_are_not_emulated() {
    let Some(said) = client("again", "127.48.17.8") else { return };
    assert!(said.ends_with("all is as it says\n"), "{said}");
}

#[test]
fn the_adapters_requests_are_those_of_ur_rtde() {
    let Some(theirs) = client("bytes", "127.48.17.6") else { return };
    let ours = [
        encode(kind::PROTOCOL, &VERSION.to_be_bytes()),
        encode(kind::SOFTWARE, &[]),
        // It ends its list with a comma.
        recipe(Some(125.0), "timestamp,actual_q,robot_mode,"),
        encode(kind::START, &[]),
    ];
    let ours = ours.map(|packet| packet.iter().map(|byte| format!("{byte:02x}")).collect::<String>());
    for packet in &ours {
        assert!(theirs.lines().any(|line| line == packet), "{packet} in\n{theirs}");
    }
}
