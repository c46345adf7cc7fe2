//! Who made a request: in status, the events, the log and the outcome of a motion.

use std::process::Command;

use serde_json::Value;

use crate::support::program::{Home, eventually};

fn events(home: &Home) -> Vec<Value> {
    let log = &home.logs()[0];
    let text = home.dimos(&format!("log cat {} --json --topics /dimos/events", log.display())).with(0).out;
    text.lines().map(|line| serde_json::from_str::<Value>(line).unwrap()["data"].clone()).collect()
}

#[test]
fn motions_stops_and_holds_say_who_asked() {
    let home = Home::new();
    let run = home.run("dual-yourarm-planner");
    let user = dimos::rpc::server::who::user_name(rustix::process::getuid().as_raw());
    let moved = home.dimos("move left 0.3 0 0.3 0 0.5 0 --json").with(0).json();
    assert_eq!(moved["by"]["program"], "dimos move", "{moved}");
    assert_eq!(moved["by"]["user"], user, "{moved}");

    let mut python = Command::new("python3");
    home.settle(python.args(["-c", "from dimos_client import Client\nwith Client.connect() as r: r.stop('left')"]));
    let status = python.env("PYTHONPATH", concat!(env!("CARGO_MANIFEST_DIR"), "/assets/python")).status().unwrap();
    assert!(status.success());
    home.dimos("stop right").with(0);
    let arms = home.status()["arms"].as_array().unwrap().clone();
    let by = |arm: usize| arms[arm]["cause"]["by"]["program"].as_str().unwrap_or_default().to_owned();
    assert!(by(0).starts_with("python3") && by(1) == "dimos stop", "{} {}", by(0), by(1));
    let shown = home.dimos("status").with(0).out;
    assert!(shown.contains("right is held: stopped by an operator: dimos stop (pid "), "{shown}");
    // Its lines are printed by the recorder's thread.
    let line = format!("right is held (stopped by an operator), by dimos stop (pid {}", arms[1]["cause"]["by"]["pid"]);
    eventually("the text log", || run.err().contains(&line));
    home.dimos("stop").with(0);
    let again = home.status()["arms"][0]["cause"]["by"]["program"].clone();
    assert_eq!(again, "dimos stop", "the last one counts");
    run.end(rustix::process::Signal::INT).with(130);

    let events = events(&home);
    let by = |kind: &str, arm: &str, status: &str| {
        let found = |e: &&Value| e["kind"] == kind && e["arm"] == arm && e["status"] == status;
        events.iter().find(found).map(|e| e["by"].as_str().unwrap().to_owned())
    };
    assert!(by("arm", "left", "held").unwrap().starts_with("python3"), "{events:?}");
    assert!(by("arm", "right", "held").unwrap().starts_with("dimos stop (pid "), "{events:?}");
    let began = events.iter().find(|e| e["kind"] == "task" && e["status"] == "EXECUTING").unwrap();
    assert!(began["by"].as_str().unwrap().starts_with("dimos move (pid "), "{began}");
    // No client asked for the end of a motion.
    assert!(events.iter().filter(|e| e["status"] == "COMPLETED").all(|e| e["by"] == ""), "{events:?}");
}
