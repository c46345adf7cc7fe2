//! Verbs that need more of the run's computer than its socket: its text log, its end, its live view, a planner that
//! works elsewhere.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::process::Stdio;
use std::time::Instant;

use rustix::process::Signal;
use serde_json::Value;

use crate::support::network::{Shared, free_port, is_built};
use crate::support::program::{Home, Started, UP, eventually};
use crate::support::terminal::Terminal;

/// An arm with a model, so that it can be shown and planned for.
const MODELLED: &str = "
include: [coordinator-yourarm]
view: {port: 0}
";

#[test]
fn the_lines_of_a_run_are_followed_through_the_end_of_its_gateway() {
    if !is_built() {
        return;
    }
    let shared = Shared::start("");
    shared.there("logs").with(0).shows(&["run cell  SIMULATED", UP, "shared at tcp/127.0.0.1:"]);
    shared.there("logs --json").with(2).says(&["--json shows files of this computer"]);
    let mut follow = shared.command("logs -f");
    let follow = Started::of(follow.stdin(Stdio::null()));
    follow.until(UP);
    let first = shared.gateway().unwrap();
    rustix::process::kill_process(rustix::process::Pid::from_raw(first).unwrap(), Signal::KILL).unwrap();
    follow.until("the gateway to other computers ended");
    assert!(follow.err().contains(" is lost"), "{}", follow.err());
    assert!(follow.err().contains("connected to run cell at"), "{}", follow.err());
    // Each line once.
    assert_eq!(follow.out().matches(UP).count(), 1, "{}", follow.out());
    shared.home.dimos("down").with(0);
    follow.until("has ended; waiting for it");
    assert!(follow.out().contains("shutdown requested"), "{}", follow.out());
    follow.end(Signal::INT);
}

#[test]
fn the_token_of_the_live_view_is_in_no_text_log() {
    if !is_built() {
        return;
    }
    let (home, port, terminal) = (Home::new(), free_port(), Terminal::new(160, 40));
    home.write("cell.yaml", &format!("{MODELLED}share: {{listen: ['tcp/127.0.0.1:{port}']}}\n"));
    let run = terminal.start(&home, "run cell.yaml --no-record");
    terminal.until(UP);
    // A person at the terminal gets it.
    let url = home.dimos("view").with(0).out;
    let token = url.trim().rsplit_once('#').unwrap().1.to_owned();
    assert!(terminal.text().contains(&token), "{}", terminal.text());
    let logs = format!("--at tcp/127.0.0.1:{port} logs");
    eventually("it is shared", || home.dimos(&logs).code == Some(0));
    let logged = home.dimos(&logs).with(0).out;
    assert!(logged.contains(UP) && !logged.contains(&token), "{logged}");
    assert!(!logged.contains('\x1b'), "{logged:?}");
    run.end(Signal::INT);
}

#[test]
fn an_owner_ends_a_run_elsewhere_and_no_one_else_does() {
    if !is_built() {
        return;
    }
    let shared = Shared::start(", users: {'-': operator}");
    shared.there("down").with(1).says(&["[FORBIDDEN]", "has the role operator here", "`shutdown`"]);
    shared.there("state").with(0);
    drop(shared);
    let shared = Shared::start(", users: {'-': owner}");
    shared.there("down other").with(2).says(&["no live run is named"]);
    let began = Instant::now();
    shared.there("down").with(0).says(&["cell at tcp/127.0.0.1:", "ended"]);
    assert!(began.elapsed().as_secs_f64() < 5.0, "{:?}", began.elapsed());
    let ended = shared.run.wait().with(0);
    assert!(!ended.err.contains("the gateway to other computers ended"), "{}", ended.err);
}

#[test]
fn a_verb_that_waits_is_told_that_the_run_has_ended() {
    if !is_built() {
        return;
    }
    let shared = Shared::start(", users: {'-': operator}");
    let mut away = shared.command("move arm 0.8 0 0 0 0 0 --speed 0.1");
    let away = Started::of(away.stdin(Stdio::null()));
    eventually("the arm moves", || shared.home.positions("arm")[0] > 0.01);
    shared.home.dimos("down").with(0);
    away.wait().with(1);
}

/// Status and content of a file of a page.
fn get(url: &str, path: &str) -> (u16, Vec<u8>) {
    let (host, token) = url.trim().strip_prefix("http://").unwrap().split_once("/#").unwrap();
    let mut stream = TcpStream::connect(host).unwrap();
    let request = format!("GET /{path} HTTP/1.1\r\nHost: {host}\r\nAuthorization: Bearer {token}\r\n\r\n");
    stream.write_all(request.as_bytes()).unwrap();
    let mut reply = Vec::new();
    stream.read_to_end(&mut reply).unwrap();
    let end = reply.windows(4).position(|four| four == b"\r\n\r\n").unwrap();
    let head = String::from_utf8_lossy(&reply[..end]).into_owned();
    (head.split(' ').nth(1).unwrap().parse().unwrap(), reply[end + 4..].to_vec())
}

#[cfg(feature = "view")]
#[test]
fn the_page_of_a_run_elsewhere_is_served_here() {
    use tungstenite::{Message, connect};

    if !is_built() {
        return;
    }
    let (home, port) = (Home::new(), free_port());
    let share = format!("share: {{listen: ['tcp/127.0.0.1:{port}'], users: {{'-': operator}}}}\n");
    home.write("cell.yaml", &format!("{MODELLED}{share}"));
    let run = Started::of(home.as_typed("run cell.yaml --sim --no-record").stdin(Stdio::null()));
    run.until(UP);
    eventually("the run is shared", || home.status()["share"].is_object());
    let view = Started::of(home.as_typed(&format!("--at tcp/127.0.0.1:{port} view")).stdin(Stdio::null()));
    view.until("Ctrl-C ends the page");
    // The two outputs are read by two threads.
    eventually("the URL is printed", || view.out().contains("/#"));
    let (there, here) = (view.out(), home.dimos("view").with(0).out);
    assert_ne!(there, here);
    // The same robots, from another server with another token.
    let (scene, same) = (get(&there, "scene.json"), get(&here, "scene.json"));
    assert_eq!((scene.0, &scene.1), (200, &same.1));
    assert_eq!(serde_json::from_slice::<Value>(&scene.1).unwrap()["robots"][0]["name"], "arm");
    assert_eq!(get(&there, "mesh/999").0, 404);
    assert_eq!(
        get(there.rsplit_once('#').map(|(url, _)| format!("{url}#wrong")).unwrap().as_str(), "scene.json").0,
        401
    );

    let (host, token) = there.trim().strip_prefix("http://").unwrap().split_once("/#").unwrap();
    let (mut page, _) = connect(format!("ws://{host}/rpc")).unwrap();
    let mut asks = |line: String| {
        page.send(Message::text(line)).unwrap();
        serde_json::from_str::<Value>(page.read().unwrap().to_text().unwrap()).unwrap()
    };
    assert_eq!(asks(format!(r#"{{"token": "{token}"}}"#))["ok"], true);
    let state = asks(r#"{"id": 1, "method": "state", "params": {}}"#.to_owned());
    assert_eq!(state["result"]["arms"][0]["hardware_id"], "arm", "{state}");
    // With this user's role.
    let refused = asks(r#"{"id": 2, "method": "shutdown", "params": {}}"#.to_owned());
    assert_eq!(refused["error"]["code"], "FORBIDDEN", "{refused}");
    assert_eq!(view.end(Signal::INT).code, Some(130));
}

#[test]
fn a_run_without_a_page_says_so_elsewhere_too() {
    if !is_built() {
        return;
    }
    let shared = Shared::start("");
    shared.there("view").with(1).says(&["run cell has no live view", "hint: "]);
    shared.there("view log.mcap").with(2).says(&["--at shows a run"]);
}

#[test]
fn a_planner_on_another_computer_plans_for_a_run() {
    if !is_built() {
        return;
    }
    let shared = Shared::of("include: [coordinator-yourarm]\n", ", users: {'-': operator}");
    let home = &shared.home;
    let wrong = home.dimos(&format!("--at {} run coordinator-yourarm", shared.at)).with(2);
    wrong.says(&["a run starts on the computer of its arms", "has no planner to attach"]);
    home.dimos(&format!("--at {} run ur5e-planner", shared.at)).with(1).says(&["no run at", "has the arms of ur5e"]);
    let planner = Started::of(home.command("run yourarm-planner").args(["--at", &shared.at]).stdin(Stdio::null()));
    planner.until("attached to run cell at tcp/127.0.0.1:");
    let attached = &shared.home.status()["planner"]["attached"];
    assert_eq!((&attached["name"], &attached["pid"]), (&"yourarm-planner".into(), &Value::Null));
    shared.there("plan arm 0.3 -0.2 0.5 0 0.4 0").with(0);
    shared.there("execute").with(0);
    assert!((home.positions("arm")[0] - 0.3).abs() < 0.01);
    // Nothing is asked of it: it notices all the same.
    let first = shared.gateway().unwrap();
    rustix::process::kill_process(rustix::process::Pid::from_raw(first).unwrap(), Signal::KILL).unwrap();
    planner.until("attached to run cell again");
    shared.there("plan arm 0.2 -0.2 0.5 0 0.4 0").with(0);
    assert!(planner.err().contains("FAULT: run cell: the run is gone"), "{}", planner.err());
    assert!(std::fs::read_dir(home.path().join("run/dimos/relays")).unwrap().count() > 0);
    planner.end(Signal::TERM).with(143);
    assert_eq!(std::fs::read_dir(home.path().join("run/dimos/relays")).unwrap().count(), 0);
}
