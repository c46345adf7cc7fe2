//! A run on the network, with the real binary: verbs with `--at`, who may do what, and what is said if it fails.

use std::process::Stdio;
use std::time::Instant;

use rustix::process::Signal;
use serde_json::{Value, json};

use crate::support::network::{CELL, Judge, Shared, free_port, is_built};
use crate::support::program::{Home, Started, eventually};

#[test]
fn a_build_without_the_network_says_so() {
    if cfg!(feature = "share") {
        return;
    }
    let home = Home::new();
    let at = format!("tcp/127.0.0.1:{}", free_port());
    home.as_typed(&format!("--at {at} status"))
        .output()
        .map(crate::support::program::Ended::from)
        .unwrap()
        .with(1)
        .says(&["this build reaches no other computer", "hint: "]);
}

#[test]
fn verbs_work_from_another_computer_as_they_do_here() {
    if !is_built() {
        return;
    }
    let shared = Shared::start(", users: {'-': operator}");
    shared.there("status").with(0).shows(&["cell", "arm", "shared at tcp/127.0.0.1:"]);
    shared.there("state").with(0).shows(&["arm_joint1"]);
    shared.there("move arm 0.3 0 0 0 0 0").with(0);
    assert!((shared.home.positions("arm")[0] - 0.3).abs() < 0.01);
    // The place may follow the verb, and be in the environment.
    shared.home.dimos(&format!("state --json --at {}", shared.at)).with(0).shows(&["arm_joint1"]);
    let mut state = shared.home.as_typed("state --json");
    Started::of(shared.home.settle(state.env("DIMOS_AT", &shared.at)).stdin(Stdio::null())).wait().with(0);

    let unknown = shared.there("move rarm 0 0 0 0 0 0").with(2);
    unknown.says(&["no arm named", "did you mean `arm`?"]);
    shared.there("move arm 9 0 0 0 0 0").with(1).says(&["[OUT_OF_LIMITS]"]);
    shared.there("--run other status").with(2);
    shared.home.dimos(&format!("--at {} status --run other", shared.at)).with(2).says(&["no live run is named"]);
    shared.home.dimos(&format!("--at {} list-adapters", shared.at)).with(2).says(&["works on this computer only"]);
    // A verb that has ended is no commander that is lost.
    assert!(!shared.there("logs").with(0).out.contains("is lost"), "{}", shared.run.err());
}

#[test]
fn a_commander_elsewhere_is_named_and_is_one_of_many() {
    if !is_built() {
        return;
    }
    let shared = Shared::start(", users: {'-': operator}");
    let mut stream = shared.command("task stream velocity_arm");
    let mut stream = Started::of(stream.stdin(Stdio::piped()));
    let mut targets = stream.stdin();
    std::io::Write::write_all(&mut targets, b"0 0 0 0 0 0\n").unwrap();
    eventually("it holds the lease", || shared.commander().is_some());
    let name = shared.commander().unwrap();
    assert!(name.starts_with("someone (dimos task on "), "{name}");
    let named = format!("arm is commanded by {name}");
    shared.home.dimos("move arm 0 0 0 0 0 0").with(1).says(&[&named, "[LEASE_HELD]"]);
    shared.there("move arm 0 0 0 0 0 0").with(1).says(&[&named, "[LEASE_HELD]"]);
    eventually("verbs that have ended are gone", || shared.home.status()["share"]["clients"] == json!([name]));
    drop(targets);
    stream.wait();
    eventually("the lease is free", || shared.commander().is_none());
}

#[test]
fn stop_reaches_the_runs_here_and_those_of_the_environment() {
    if !is_built() {
        return;
    }
    let shared = Shared::start("");
    shared.there("stop").with(0).shows(&["confirmed"]);
    shared
        .there("arm reset arm")
        .with(1)
        .says(&["[FORBIDDEN]", "a client without a certificate has the role observer"]);
    let here = Home::new();
    here.write("cell.yaml", CELL);
    let _run = here.run("cell.yaml --no-record --name here");
    let stop = |at: &str| {
        let mut stop = here.as_typed("stop --json");
        Started::of(stop.env("DIMOS_AT", at).stdin(Stdio::null())).wait()
    };
    let both = stop(&shared.at).with(0).json();
    assert_eq!(both, json!({"cell": {"arms": {"arm": "confirmed"}}, "here": {"arms": {"arm": "confirmed"}}}));
    let nowhere = format!("tcp/127.0.0.1:{}", free_port());
    stop(&nowhere).with(1).says(&["nothing listens at", "UNREACHABLE"]).shows(&["here"]);
}

#[test]
fn n06_a_run_that_is_killed_is_told_at_once_and_leaves_no_gateway() {
    if !is_built() {
        return;
    }
    let shared = Shared::start(", users: {'-': operator}");
    let gateway = shared.gateway().unwrap();
    let mut away = shared.command("move arm 0.8 0 0 0 0 0 --speed 0.1");
    let away = Started::of(away.stdin(Stdio::null()));
    let mut watch = shared.command("state --watch --json");
    let watch = Started::of(watch.stdin(Stdio::null()));
    watch.until("arm_joint1");
    eventually("the arm moves", || shared.home.positions("arm")[0] > 0.01);
    shared.run.signal(Signal::KILL);
    let killed = Instant::now();
    let ended = away.wait().with(1);
    assert!(killed.elapsed().as_secs_f64() < 1.5, "{:?}", killed.elapsed());
    ended.says(&["[LOST]", "the connection to tcp/127.0.0.1:", "may still take effect"]);
    // This one waits until it is back.
    watch.until(" is lost");
    assert!(killed.elapsed().as_secs_f64() < 3.0, "{:?}", killed.elapsed());
    eventually("the gateway is gone", || !std::path::Path::new(&format!("/proc/{gateway}/exe")).exists());
    shared.there("state").with(3).says(&["nothing listens at", "hint: "]);
}

#[test]
fn n14_a_run_has_one_gateway() {
    if !is_built() {
        return;
    }
    let shared = Shared::start("");
    let second = format!("share --listen tcp/127.0.0.1:{}", free_port());
    shared.home.dimos(&second).with(1).says(&["the run is shared already at tcp/127.0.0.1:", "[HAS_GATEWAY]"]);
}

#[test]
fn n15_a_run_is_not_open_to_the_network_by_mistake() {
    let home = Home::new();
    let check = |share: &str| {
        home.write("open.yaml", &format!("{CELL}share: {share}\n"));
        home.dimos("check open.yaml")
    };
    let refused = check("{listen: [tcp/0.0.0.0:7447]}").with(2);
    refused.says(&["open.yaml:7:", "tcp/0.0.0.0:7447 is open to the network", "insecure: true"]);
    check("{listen: [tcp/0.0.0.0:7447], insecure: true}").with(0);
    check("{listen: [tls/0.0.0.0:7447]}").with(2).says(&["needs certificates"]);
    check("{listen: []}").with(2).says(&["it listens nowhere"]);
    check("{listen: [udp/0.0.0.0:7447]}").with(2).says(&["is no endpoint"]);
    check("{listen: [tcp/127.0.0.1:7447], users: {'a/b': owner}}").with(2).says(&["cannot be a user"]);
}

#[test]
fn another_program_speaks_the_protocol_with_the_page_alone() {
    if !is_built() {
        return;
    }
    let shared = Shared::start(", users: {'-': operator}");
    let Some(mut judge) = Judge::open(&shared.at, "-", Value::Null) else { return };
    let id = judge.opened["id"].as_str().unwrap().to_owned();
    assert_eq!(judge.does("tokens", json!({"key": "dimos/*/alive"})), json!(["dimos/cell/alive"]));
    judge.does("announce", json!({}));
    judge.does("beat", json!({"name": "policy.py on gpu"}));
    let state = judge.asks("read", "state", json!({}));
    assert_eq!(state["result"]["arms"][0]["hardware_id"], "arm", "{state}");
    judge.does("subscribe", json!({"stream": "coordinator_joint_state"}));
    let moved = judge.asks("move", "move", json!({"arm": "arm", "target": [0.1, 0, 0, 0, 0, 0]}));
    assert!(moved["result"]["motion"].is_u64(), "{moved}");
    assert_eq!(shared.commander().as_deref(), Some("someone (policy.py on gpu)"), "client {id}");
    let wrong = judge.asks("move", "move", json!({"arm": "arm", "target": [9, 0, 0, 0, 0, 0]}));
    assert_eq!(
        (&wrong["error"]["code"], &wrong["encoding"]),
        (&json!("OUT_OF_LIMITS"), &json!("application/json;dimos-error"))
    );
    eventually("it hears every tick", || judge.does("heard", json!({}))["count"].as_u64() > Some(50));
    assert_eq!(judge.does("heard", json!({}))["lost"], 0);
}

#[test]
fn the_python_client_works_from_another_computer() {
    if !is_built() {
        return;
    }
    let Some(python) = crate::support::python::python_with(&["zenoh"]) else { return };
    let shared = Shared::start(", users: {'-': operator}");
    let script = "
import sys
from dimos_client import Client, Refused
with Client.at(sys.argv[1]) as robot:
    print(robot.move('arm', [0.2, 0, 0, 0, 0, 0], speed=1.0)['state'])
    try:
        robot.call('move', arm='arm', target=[9, 0, 0, 0, 0, 0])
    except Refused as refused:
        print(refused.code)
    states = robot.call('subscribe', stream='coordinator_joint_state')
    print(states['subscription'] >= 1 << 32)
    print(robot.call('stop')['arms'])
";
    let client = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/python");
    let mut command = std::process::Command::new(python);
    command.args(["-c", script, &shared.at]).env("PYTHONPATH", client).env("PYTHONDONTWRITEBYTECODE", "1");
    let ended = Started::of(command.stdin(Stdio::null())).wait().with(0);
    assert_eq!(ended.out, "COMPLETED\nOUT_OF_LIMITS\nTrue\n{'arm': 'confirmed'}\n", "{}", ended.err);
}
