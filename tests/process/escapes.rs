//! Texts of a device and of a blueprint that a terminal would execute: every verb that can print them shows them
//! instead, and JSON stays JSON with the same values.

use std::process::{Command, Stdio};

use serde_json::Value;

use crate::support::program::{Home, Started, eventually};
use crate::support::skip::skip;

/// The text of `HOSTILE` in `tests/python/sim_arm.py`.
const SHOWN: &str = r"\u{1b}]0;owned\u{7}\u{1b}[2J\u{202e}evil\u{7f}\u{9b}5m";

const BLUEPRINT: &str = r#"
name: hostile
description: "\e]0;owned\a\e[2J\u202eevil\x7f\x9b5m"
hardware:
  - {hardware_id: arm, joints: {prefix: arm, count: 6}, adapter_type: remote,
     address: "unix:FOLDER/arm.sock", accept_zero_pose: true}
tasks:
  - {name: traj_arm, type: trajectory, joint_names: {hardware: arm}}
"#;

/// Characters that a terminal executes, or that reorder others.
fn hidden(text: &str) -> Vec<char> {
    let is_hidden = |c: &char| {
        !matches!(c, '\n' | '\t') && c.is_control()
            || matches!(c, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
    };
    text.chars().filter(is_hidden).collect()
}

#[test]
fn no_verb_sends_a_terminal_what_a_device_or_a_blueprint_says() {
    let home = Home::new();
    let tree = env!("CARGO_MANIFEST_DIR");
    let mut shim = Command::new("python3");
    shim.arg(format!("{tree}/assets/python/dimos_shim.py")).args(["sim_arm:HostileAdapter", "--address", "sim"]);
    shim.args(["--dof", "6", "--at", &format!("unix:{}/arm.sock", home.path().display())]).stdin(Stdio::null());
    home.settle(&mut shim).current_dir(format!("{tree}/tests/python")).env("PYTHONPYCACHEPREFIX", home.path());
    if Command::new("python3").arg("--version").output().is_err() {
        return skip("python3");
    }
    let shim = Started::of(&mut shim);
    shim.until("Ctrl-C ends it");
    home.write("hostile.yaml", &BLUEPRINT.replace("FOLDER", &home.path().display().to_string()));
    home.dimos("run hostile.yaml --daemon --duration 2m --record log.mcap").with(0);
    shim.signal(rustix::process::Signal::USR1);
    eventually("the arm reports its error", || home.status()["arms"][0]["error"]["text"].is_string());
    assert_eq!(home.runs().runs().unwrap().len(), 1);
    let mut shown = 0;
    let mut look = |verb: &str| {
        let ended = home.dimos(verb);
        let text = ended.out.clone() + &ended.err;
        assert!(!text.is_empty() || verb.starts_with("speed"), "{verb} prints nothing");
        assert_eq!(hidden(&text), [], "{verb}: {text:?}");
        shown += usize::from(text.contains(SHOWN));
        if verb.contains("--json") {
            for line in ended.out.lines().chain(ended.err.lines().filter(|line| line.starts_with('{'))) {
                serde_json::from_str::<Value>(line).unwrap_or_else(|e| panic!("{verb}: {e}: {line}"));
            }
        }
    };
    for verb in [
        "status",
        "status --json",
        "state",
        "state --json",
        "check hostile.yaml",
        "check hostile.yaml --json",
        "list-blueprints",
        "arm reset arm",
        "arm reset arm --json",
        "arm enable arm",
        "arm enable arm --json",
        "arm disable arm",
        "move arm 0.1 0 0 0 0 0",
        "move arm 0.1 0 0 0 0 0 --json",
        "task list",
        "stop",
        "stop --json",
        "cancel",
        "doctor",
        "logs",
        "logs --json",
        "run hostile.yaml",
        "down",
        "logs",
    ] {
        look(verb);
    }
    for verb in [
        "log info log.mcap",
        "log info log.mcap --json",
        "log cat log.mcap --topics /rosout",
        "log cat log.mcap",
        "log cat log.mcap --json",
        "log doctor log.mcap",
        "log export log.mcap --topic /rosout",
        "replay log.mcap --rate 100",
        "replay log.mcap --rate 100 --json",
        "replay log.mcap --verify",
    ] {
        look(verb);
    }
    assert!(shown >= 4, "the texts are hardly shown: {shown}");
}
