//! A run with two arms, planner, page and recorder, and a client that comes every second and goes: nothing of it grows,
//! and what it says is true. `make soak` does this for an hour (`DIMOS_SOAK_HOUR=3600`), the tests for a few seconds.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use dimos::rpc::api::{Move, Plan, State, Status};
use rustix::process::Signal;
use serde_json::json;

use crate::support::program::{Home, UP};
use crate::support::usage::Usage;

/// Without `DIMOS_SOAK_HOUR` [s].
const SHORT: f64 = 12.0;
/// A run is what it stays after this time [s], and at most a third of it all.
const SETTLED: f64 = 600.0;
/// Growth that is none [bytes], of a run that has settled.
const FLAT: u64 = 1 << 20;
/// How far a joint may be from what `state` says of it, at rest [rad].
const SAME: f64 = 1e-3;

/// A client: it connects, looks, asks for something, and goes.
fn visit(home: &Home, number: u64) {
    let mut client = home.client();
    let status = client.call(Status {}).unwrap();
    assert!(status.arms.iter().all(|arm| arm.phase == "ready"), "{status:?}");
    let state = client.call(State {}).unwrap();
    let arm = &state.arms[(number % 2) as usize];
    let here: Vec<f64> = arm.joints.iter().map(|joint| joint.position.unwrap()).collect();
    let target: Vec<f64> = here.iter().enumerate().map(|(j, q)| if j == 5 { -q.signum() * 0.2 } else { *q }).collect();
    let name = arm.hardware_id.clone();
    match number % 3 {
        0 => drop(client.call(Move {
            arm: name,
            target,
            path: None,
            speed: 0.5,
            max_velocity: None,
            max_acceleration: None,
            direct: true,
        })),
        1 => {
            let plan: Result<Plan, _> = serde_json::from_value(json!({"robot": name, "joints": target}));
            if let Ok(plan) = plan {
                drop(client.call(plan));
            }
        }
        _ => {}
    }
}

/// A browser that asks for the page, and goes.
fn look(url: &str) {
    let host = url.trim_start_matches("http://").split('/').next().unwrap_or_default().to_owned();
    let mut stream = TcpStream::connect(&host).unwrap();
    stream.write_all(format!("GET / HTTP/1.1\r\nHost: {host}\r\n\r\n").as_bytes()).unwrap();
    let mut page = Vec::new();
    stream.read_to_end(&mut page).unwrap();
    assert!(page.starts_with(b"HTTP/1.1 200"), "{}", String::from_utf8_lossy(&page[..page.len().min(80)]));
}

#[test]
fn a_run_that_is_visited_every_second_does_not_grow() {
    let seconds: f64 = std::env::var("DIMOS_SOAK_HOUR").ok().and_then(|s| s.parse().ok()).unwrap_or(SHORT);
    let home = Home::new();
    let run = crate::support::program::Started::of(
        home.as_typed("run dual-yourarm-planner --sim --set view.port=0").stdin(std::process::Stdio::null()),
    );
    run.until(UP);
    home.dimos("arm enable left").with(0);
    home.dimos("arm enable right").with(0);
    let found = home.runs().runs().unwrap();
    let url = found.first().and_then(|run| dimos::rpc::client::view_url(&run.name, &run.socket));
    let pid = run.pid().to_string();
    let (began, settled) = (Instant::now(), SETTLED.min(seconds / 3.0));
    let (mut number, mut first): (u64, Option<Usage>) = (0, None);
    while began.elapsed().as_secs_f64() < seconds {
        let due = began + Duration::from_secs(number);
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        visit(&home, number);
        if let Some(url) = &url {
            look(url);
        }
        number += 1;
        if first.is_none() && began.elapsed().as_secs_f64() >= settled {
            std::thread::sleep(Duration::from_millis(300));
            first = Some(Usage::of(&pid));
        }
    }
    std::thread::sleep(Duration::from_secs(2));
    let (first, last) = (first.unwrap(), Usage::of(&pid));
    println!("{seconds} s, {number} visits: {first:?}, then {last:?}");
    assert_eq!((last.files, last.threads), (first.files, first.threads), "{first:?} {last:?}");
    assert!(seconds < SETTLED || last.memory <= first.memory + FLAT, "{first:?} {last:?}");
    let (told, again) = (home.positions("left"), home.positions("left"));
    assert!(told.iter().zip(&again).all(|(a, b)| (a - b).abs() < SAME), "at rest it moves");
    run.end(Signal::INT).with(130);
    home.dimos("log verify --last").with(0).shows(&["reproducible"]);
}
