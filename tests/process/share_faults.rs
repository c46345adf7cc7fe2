//! What breaks on a network: commanders that are killed or freeze, a gateway that dies, messages that are too large,
//! too many or not ours. N01 … of the design.

use std::io::Write;
use std::process::{ChildStdin, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::{Value, json};

use crate::support::network::{AT_ONCE, Judge, Shared, is_built};
use crate::support::program::{Started, eventually};

/// Silence after which a commander is lost, as configured by default, and a margin for a busy computer.
const LOST_AFTER: Duration = Duration::from_millis(1300 + 500);

/// Two programs of one user on other computers, announced.
fn announced(shared: &Shared) -> Option<[Judge; 2]> {
    let mut both = [Judge::open(&shared.at, "-", Value::Null)?, Judge::open(&shared.at, "-", Value::Null)?];
    both.iter_mut().for_each(|judge| drop(judge.does("announce", json!({}))));
    Some(both)
}

/// A verb on another computer that holds the lease and keeps the arm moving, until its input ends.
fn commander(shared: &Shared) -> (Started, ChildStdin) {
    let mut stream = shared.command("task stream velocity_arm");
    let mut stream = Started::of(stream.stdin(Stdio::piped()));
    let mut targets = stream.stdin();
    targets.write_all(b"0 0 0 0 0 0\n").unwrap();
    eventually("it holds the lease", || shared.commander().is_some());
    (stream, targets)
}

fn signal(pid: i32, signal: Signal) {
    kill_process(Pid::from_raw(pid).unwrap(), signal).unwrap();
}

fn is_free_within(shared: &Shared, limit: Duration) {
    let began = Instant::now();
    eventually("the lease is free", || shared.commander().is_none());
    assert!(began.elapsed() < limit, "{:?} (limit {limit:?})", began.elapsed());
}

/// Resident memory of a process [MiB].
fn memory(pid: i32) -> f64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    line.trim().trim_end_matches(" kB").parse::<f64>().unwrap() / 1024.0
}

#[test]
fn n01_a_commander_that_is_killed_loses_its_lease_and_its_motion() {
    if !is_built() {
        return;
    }
    for (on_lost, arrives) in [("cancel", false), ("finish", true)] {
        let shared = Shared::start(&format!(", users: {{'-': operator}}, on_lost: {on_lost}"));
        let mut away = shared.command("move arm 0.8 0 0 0 0 0 --speed 0.2");
        let away = Started::of(away.stdin(Stdio::null()));
        eventually("the arm moves", || shared.home.positions("arm")[0] > 0.02);
        away.end(Signal::KILL);
        is_free_within(&shared, AT_ONCE);
        eventually("the motion ends", || shared.home.status()["tasks"][0]["state"] != "EXECUTING");
        let position = shared.home.positions("arm")[0];
        assert_eq!((position - 0.8).abs() < 0.01, arrives, "{on_lost}: {position}");
        assert_eq!(
            shared.home.status()["arms"][0]["phase"],
            "ready",
            "a commander that is lost is no fault of the arm"
        );
    }
}

#[test]
fn n02_a_commander_that_freezes_loses_its_lease_and_is_told() {
    if !is_built() {
        return;
    }
    let shared = Shared::start(", users: {'-': operator}");
    let (stream, mut targets) = commander(&shared);
    stream.signal(Signal::STOP);
    is_free_within(&shared, LOST_AFTER);
    let before = shared.home.positions("arm");
    targets.write_all(b"0.5 0 0 0 0 0\n0.5 0 0 0 0 0\n").unwrap();
    stream.signal(Signal::CONT);
    let ended = stream.wait().with(1);
    assert!(ended.err.contains("[LOST]"), "{}", ended.err);
    let after = shared.home.positions("arm");
    assert!(before.iter().zip(&after).all(|(a, b)| (a - b).abs() < 1e-6), "{before:?} {after:?}");
}

#[test]
fn n02_a_silent_commander_must_take_its_lease_again() {
    if !is_built() {
        return;
    }
    let shared = Shared::start(", users: {'-': operator}, client_timeout: 0.5");
    let Some(mut judge) = Judge::open(&shared.at, "-", Value::Null) else { return };
    judge.does("announce", json!({}));
    judge.does("beat", json!({}));
    let target = json!({"task": "velocity_arm", "velocities": [0.0, 0, 0, 0, 0, 0]});
    assert_eq!(judge.asks("move", "velocity", target.clone())["result"], json!({}));
    // Its session is open, it only does not beat: zenoh sees nothing wrong.
    is_free_within(&shared, LOST_AFTER);
    assert_eq!(judge.asks("move", "velocity", target.clone())["error"]["code"], "LOST");
    assert!(judge.asks("read", "state", json!({}))["result"].is_object(), "reading needs no lease");
    assert_eq!(judge.asks("move", "lease", json!({}))["result"], json!({"arms": ["arm"]}));
    assert_eq!(judge.asks("move", "velocity", target)["result"], json!({}));
}

#[test]
fn n04_a_frozen_subscriber_delays_no_other() {
    if !is_built() {
        return;
    }
    let shared = Shared::start("");
    let Some(mut good) = Judge::open(&shared.at, "-", Value::Null) else { return };
    let Some(mut frozen) = Judge::open(&shared.at, "-", Value::Null) else { return };
    for judge in [&mut good, &mut frozen] {
        judge.does("announce", json!({}));
        judge.does("subscribe", json!({"stream": "coordinator_joint_state"}));
    }
    eventually("both hear it", || {
        [&mut good, &mut frozen].iter_mut().all(|j| j.does("heard", json!({}))["count"].as_u64() > Some(10))
    });
    let before = good.does("heard", json!({}));
    let frozen_pid = frozen.pid() as i32;
    signal(frozen_pid, Signal::STOP);
    // Longer than the time after which zenoh gives the frozen one up.
    std::thread::sleep(Duration::from_secs(2));
    let after = good.does("heard", json!({}));
    let heard = after["count"].as_u64().unwrap() - before["count"].as_u64().unwrap();
    signal(frozen_pid, Signal::CONT);
    assert!(heard > 150, "{heard} of about 200 messages in 2 s");
    assert_eq!(after["lost"], before["lost"]);
}

#[test]
fn n05_a_gateway_that_is_killed_in_motion_is_started_again() {
    if !is_built() {
        return;
    }
    let shared = Shared::start(", users: {'-': operator}");
    let mut away = shared.command("move arm 0.8 0 0 0 0 0 --speed 0.2");
    let away = Started::of(away.stdin(Stdio::null()));
    eventually("the arm moves", || shared.home.positions("arm")[0] > 0.02);
    let first = shared.gateway().unwrap();
    signal(first, Signal::KILL);
    is_free_within(&shared, AT_ONCE);
    away.wait().with(1).says(&["[LOST]", "may still take effect"]);
    eventually("the motion is cancelled", || shared.home.status()["tasks"][0]["state"] != "EXECUTING");
    assert!(shared.home.positions("arm")[0] < 0.7);
    eventually("it is back", || shared.gateway().is_some_and(|pid| pid != first));
    let back = Instant::now();
    eventually("clients are served", || shared.there("state").code == Some(0));
    assert!(back.elapsed() < Duration::from_secs(2), "{:?}", back.elapsed());
    assert!(shared.run.err().contains("the gateway to other computers ended"), "{}", shared.run.err());
}

#[test]
fn n07_a_message_of_200_mib_is_dropped() {
    if !is_built() {
        return;
    }
    let shared = Shared::start("");
    let Some(mut judge) = Judge::open(&shared.at, "-", Value::Null) else { return };
    judge.does("announce", json!({}));
    judge.asks("read", "state", json!({}));
    let gateway = shared.gateway().unwrap();
    let before = memory(gateway);
    let huge = json!({"cls": "read", "method": "state", "size": 200 << 20, "timeout": 3.0});
    let answer = judge.does("ask", huge);
    assert!(answer["result"].is_null(), "{answer}");
    let grown = memory(gateway) - before;
    assert!(grown < 32.0, "the gateway has grown by {grown:.0} MiB");
    let too_large = judge.does("ask", json!({"cls": "read", "method": "state", "size": 300_000}));
    assert_eq!(too_large["error"]["code"], "TOO_LARGE");
    eventually("the next request is answered", || judge.asks("read", "state", json!({}))["result"].is_object());
    assert_eq!(shared.gateway(), Some(gateway));
}

#[test]
fn n08_a_flood_of_requests_is_bounded_and_delays_no_stop() {
    if !is_built() {
        return;
    }
    let shared = Shared::start("");
    let Some([mut judge, mut other]) = announced(&shared) else { return };
    let flooding = std::thread::spawn(move || {
        let answer = judge.does("flood", json!({"method": "state", "cls": "read", "count": 2000}));
        (judge, answer)
    });
    std::thread::sleep(Duration::from_millis(100));
    let stop = other.asks("end", "stop", json!({}));
    assert_eq!(stop["result"]["arms"]["arm"], "confirmed", "{stop}");
    assert!(stop["took"].as_f64().unwrap() < AT_ONCE.as_secs_f64(), "{stop}");
    let (mut judge, answer) = flooding.join().unwrap();
    let (done, refused) = (answer["done"].as_u64().unwrap(), answer["refused"].as_u64().unwrap());
    assert!(done >= 32, "{answer}");
    assert!(refused == 0 || answer["codes"]["TOO_MANY_REQUESTS"].as_u64() > Some(0), "{answer}");
    assert!(judge.asks("read", "state", json!({}))["result"].is_object());
}

#[test]
fn every_request_that_ends_motion_is_answered_and_no_cancel_takes_the_place_of_a_stop() {
    if !is_built() {
        return;
    }
    let shared = Shared::start(", users: {'-': operator}");
    let Some([mut judge, mut other]) = announced(&shared) else { return };
    let run = shared.run.pid() as i32;
    signal(run, Signal::STOP);
    let cancelling = std::thread::spawn(move || {
        let flood = judge.does("flood", json!({"method": "cancel", "cls": "end", "count": 60}));
        (judge, flood)
    });
    std::thread::sleep(Duration::from_millis(500));
    let stopping = std::thread::spawn(move || {
        let stop = other.asks("end", "stop", json!({}));
        (other, stop)
    });
    std::thread::sleep(Duration::from_millis(500));
    signal(run, Signal::CONT);
    let (_other, stop) = stopping.join().unwrap();
    assert_eq!(stop["result"]["arms"]["arm"], "confirmed", "{stop}");
    let (_judge, flood) = cancelling.join().unwrap();
    let (done, refused) = (flood["done"].as_u64().unwrap(), flood["refused"].as_u64().unwrap());
    assert_eq!((done, done + refused), (16, 60), "{flood}");
    assert_eq!(flood["codes"]["TOO_MANY_REQUESTS"], refused, "{flood}");
}

#[test]
fn n18_an_id_belongs_to_the_program_that_used_it_first() {
    if !is_built() {
        return;
    }
    let shared = Shared::start(", users: {'-': operator}, client_timeout: 0.5");
    let Some(mut owner) = Judge::open(&shared.at, "-", Value::Null) else { return };
    let Some(mut thief) = Judge::open(&shared.at, "-", Value::Null) else { return };
    let id = owner.opened["id"].clone();
    let target = json!({"task": "velocity_arm", "velocities": [0.2, 0, 0, 0, 0, 0]});
    for (own, others) in
        [(Some("0123456789abcdef"), [None, Some("fedcba9876543210")]), (None, [Some("0123456789abcdef"); 2])]
    {
        let prove = |judge: &mut Judge, attachment: Option<&str>| {
            judge.does("prove", json!({"attachment": attachment.unwrap_or_default(), "id": id}))
        };
        // The second time as a program that knows nothing of attachments.
        prove(&mut owner, own);
        owner.does("announce", json!({}));
        owner.does("beat", json!({}));
        assert_eq!(owner.asks("move", "lease", json!({}))["result"], json!({"arms": ["arm"]}));
        let began = Instant::now();
        for other in others {
            prove(&mut thief, other);
            let refused = thief.asks("move", "velocity", target.clone());
            assert_eq!(refused["error"]["code"], "FORBIDDEN", "{refused}");
            assert!(refused["error"]["message"].as_str().unwrap().contains("another program has the id"), "{refused}");
            assert_eq!(thief.asks("end", "stop", json!({}))["result"]["arms"]["arm"], "confirmed");
        }
        // Beats of another program do not hide that its owner is silent.
        while began.elapsed() < Duration::from_secs(1) {
            thief.does("beat", json!({}));
            std::thread::sleep(Duration::from_millis(50));
        }
        assert!(shared.commander().is_none(), "{:?}", shared.commander());
    }
}

#[test]
fn n11_what_names_no_client_exactly_reaches_no_run() {
    if !is_built() {
        return;
    }
    let shared = Shared::start(", users: {'-': operator}");
    let Some(mut judge) = Judge::open(&shared.at, "-", Value::Null) else { return };
    judge.does("announce", json!({}));
    let id = judge.opened["id"].as_str().unwrap().to_owned();
    for key in [
        "dimos/cell/by/*/end/x/stop".to_owned(),
        "dimos/cell/by/-/*/x/stop".to_owned(),
        "dimos/cell/by/-/end/*/stop".to_owned(),
        "dimos/cell/by/**".to_owned(),
        "dimos/**".to_owned(),
        "**".to_owned(),
        format!("dimos/cell/by/alice/end/{id}/stop"),
        format!("dimos/cell/by/-/read/{id}/stop"),
        format!("dimos/cell/by/-/end/{id}/stop/more"),
        format!("dimos/cell/by/-/end/{id}/register_gateway"),
    ] {
        let answer = judge.does("ask", json!({"key": key, "timeout": 1.0}));
        assert!(answer["result"].is_null(), "{key}: {answer}");
    }
    assert_eq!(shared.home.status()["arms"][0]["phase"], "ready", "one of them stopped the arm");
    for payload in ["[1]", "7", "{", "\"x\""] {
        let key = format!("dimos/cell/by/-/end/{id}/stop");
        let answer = judge.does("raw", json!({"key": key, "payload": payload}));
        assert_eq!(answer["error"]["code"], "MALFORMED", "{payload}: {answer}");
    }
    assert_eq!(shared.home.status()["arms"][0]["phase"], "ready");
    // A token and a beat of someone else keep no one alive and kill no one.
    judge.does("announce", json!({"key": "dimos/cell/by/alice/client/77"}));
    judge.does("beat", json!({"key": "dimos/cell/by/alice/client/77/beat"}));
    let clients = shared.home.status()["share"]["clients"].to_string();
    assert!(!clients.contains("alice"), "{clients}");
}

#[test]
fn n12_garbage_costs_its_sender_only() {
    if !is_built() {
        return;
    }
    let shared = Shared::start(", users: {'-': operator}");
    let Some([mut judge, mut other]) = announced(&shared) else { return };
    assert!(judge.asks("read", "state", json!({}))["result"].is_object());
    let gateway = shared.gateway().unwrap();
    let before = memory(gateway);
    let valid = json!([
        ["read", "state", {}],
        ["read", "subscribe", {"stream": "events", "rate": 10.0}],
        ["read", "text_log", {"after": 0}],
        ["read", "page", {"path": "scene.json"}],
        ["move", "move", {"arm": "arm", "target": [0.1, 0, 0, 0, 0, 0], "speed": 0.5}],
        ["move", "velocity", {"task": "velocity_arm", "velocities": [0.0, 0, 0, 0, 0, 0]}],
        ["plan", "world_add", {"name": "a", "shape": {"box": [0.1, 0.1, 0.1]}, "pose": {"xyz": [0, 0, 0]}}],
        ["plan", "planner_answer", {"request": 1, "result": {}}],
        ["end", "cancel", {}],
        ["own", "shutdown", {}]
    ]);
    let seed = std::env::var("DIMOS_FUZZ_SEED").ok().and_then(|s| s.parse().ok()).unwrap_or(20_261_125_u64);
    println!("DIMOS_FUZZ_SEED={seed}");
    let began = Instant::now();
    for round in 0..4 {
        let codes = judge.does("fuzz", json!({"seed": seed + round, "count": 1000, "valid": valid}));
        println!("{codes}");
        assert!(codes["MALFORMED"].as_u64() > Some(0) && codes["ok"].as_u64() > Some(0), "{codes}");
        // Another client is served meanwhile, and this one after it.
        assert!(other.asks("read", "state", json!({}))["result"].is_object());
        assert!(judge.asks("read", "state", json!({}))["result"].is_object());
    }
    let grown = memory(gateway) - before;
    println!("4000 in {:?}, the gateway has grown by {grown:.1} MiB", began.elapsed());
    assert!(grown < 32.0, "the gateway has grown by {grown:.0} MiB");
    assert_eq!(shared.gateway(), Some(gateway), "the gateway has ended");
    assert!(!shared.run.err().contains("panicked"), "{}", shared.run.err());
}

#[test]
fn n16_a_stop_overtakes_a_slow_request_of_the_same_client() {
    if !is_built() {
        return;
    }
    let shared = Shared::start(", users: {'-': operator}");
    let Some(mut judge) = Judge::open(&shared.at, "-", Value::Null) else { return };
    judge.does("announce", json!({}));
    // Waits until the arm is at rest: 2 v/a + 0.25 s and more.
    let slow = json!({"cls": "move", "method": "arm_disable", "params": {"arm": "arm"}});
    judge.asks("move", "move", json!({"arm": "arm", "target": [0.8, 0, 0, 0, 0, 0], "speed": 0.3}));
    let answers = judge.does("both", json!({"slow": slow, "fast": {"cls": "end", "method": "stop", "params": {}}}));
    assert_eq!(answers["fast"]["result"]["arms"]["arm"], "confirmed", "{answers}");
    assert!(answers["fast"]["took"].as_f64() < answers["slow"]["took"].as_f64(), "{answers}");
}
