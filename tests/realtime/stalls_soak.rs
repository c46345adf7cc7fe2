//! `make soak`: runs with simulated arms, idle and moving at the same time, beside busy processes, with and without
//! real-time rights: no arm is held. `DIMOS_SOAK` is for how long each is watched [s] (10; when it is given, a computer
//! that stands still for
//! 0.1 s is no excuse), `DIMOS_SOAK_BUSY` how many processes are busy (8),
//! `DIMOS_SOAK_ALL=1` takes every shipped blueprint.

use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use dimos::rpc::api::{Execute, Point, State, Trajectory};
use dimos::rpc::client::Client;
use rustix::process::Signal;
use rustix::thread::CapabilitySet;

use crate::support::busy::Busy;
use crate::support::program::{Home, Started, UP};
use crate::support::wire::watch::Watch;

/// An arm behind another process.
const REMOTE: &str = "
hardware:
  - {hardware_id: arm, joints: {prefix: arm, count: 6}, adapter_type: remote, address: 'unix:arm.sock', accept_zero_pose: true}
tasks:
  - {name: traj_arm, type: trajectory, joint_names: {hardware: arm}}
";

fn number(variable: &str, otherwise: f64) -> f64 {
    std::env::var(variable).ok().and_then(|n| n.parse().ok()).unwrap_or(otherwise)
}

/// A run under watch.
struct Soaked {
    name: String,
    realtime: bool,
    home: Home,
    run: Option<Started>,
    /// The process behind a remote arm, outlived by nothing.
    _shim: Option<Started>,
}

impl Soaked {
    /// Starts it with or without the right to schedule in real time.
    fn start(name: &str, realtime: bool) -> Self {
        let home = Home::new();
        let shim = (name == "remote").then(|| {
            let socket = home.path().join("arm.sock");
            home.write("remote.yaml", &REMOTE.replace("arm.sock", &socket.display().to_string()));
            let in_tree = |path: &str| format!("{}/{path}", env!("CARGO_MANIFEST_DIR"));
            let mut python = Command::new("python3");
            python.args([&in_tree("assets/python/dimos_shim.py"), "sim_arm:SimArmAdapter", "--at"]);
            python.arg(format!("unix:{}", socket.display())).args(["--address", "sim", "--dof", "6"]);
            home.settle(python.stdin(Stdio::null()));
            python.current_dir(in_tree("tests/python")).env("PYTHONPYCACHEPREFIX", home.path());
            let shim = started(python, realtime);
            shim.until("Ctrl-C ends it");
            shim
        });
        let what = if name == "remote" { "run remote.yaml".to_owned() } else { format!("run {name} --sim") };
        let mut command = home.command(&what);
        command.stdin(Stdio::null());
        Self { name: name.to_owned(), realtime, run: Some(started(command, realtime)), home, _shim: shim }
    }

    fn up(&self) {
        self.run.as_ref().unwrap().until(UP);
    }

    /// Swings every joint by 0.2 rad for so long [s].
    fn move_all(&self, seconds: f64) -> Result<(), String> {
        let mut client: Client = self.home.client();
        for arm in client.call(State {}).unwrap().arms {
            let start: Vec<f64> = arm.joints.iter().map(|j| j.command.or(j.position).unwrap()).collect();
            let joint_names = arm.joints.iter().map(|j| j.name.clone()).collect();
            // Inwards, so that no joint leaves its range.
            let inwards: Vec<f64> = start.iter().map(|q| if *q > 0.0 { -0.1 } else { 0.1 }).collect();
            let turn = std::f64::consts::TAU / 4.0;
            let points = (0..=16 * (seconds / 4.0).floor() as usize).map(|i| {
                let (time, rests) = (i as f64 * 0.25, i % 16 == 0);
                let (swing, speed) = (1.0 - (turn * time).cos(), turn * (turn * time).sin());
                Point {
                    time_from_start: time,
                    positions: start.iter().zip(&inwards).map(|(q, s)| q + s * swing).collect(),
                    velocities: Some(inwards.iter().map(|s| if rests { 0.0 } else { s * speed }).collect()),
                    accelerations: None,
                }
            });
            let trajectory = Trajectory { joint_names, points: points.collect() };
            client.call(Execute { trajectory, task: None }).map_err(|e| format!("{}: {e}", self.name))?;
        }
        Ok(())
    }

    /// Ends it, and says what held an arm.
    fn end(mut self, what: &str) -> Vec<String> {
        let status = self.home.status();
        assert!(self.realtime || status["realtime"][0]["granted"] == false, "{}", status["realtime"]);
        let held = status["arms"].as_array().unwrap().iter().filter(|arm| arm["phase"] != "ready");
        let mut found: Vec<String> = held
            .map(|arm| format!("{} {what}: {} is {}: {}", self.name, arm["hardware_id"], arm["phase"], arm["cause"]))
            .collect();
        let ended = self.run.take().unwrap().end(Signal::INT);
        let told = ended.err.lines().filter(|line| line.contains("is held"));
        found.extend(told.map(|line| format!("{} {what}: {line}", self.name)));
        found
    }
}

/// Starts a process; without the right to schedule in real time it has none even as root.
fn started(mut command: Command, realtime: bool) -> Started {
    let thread = std::thread::spawn(move || {
        if !realtime {
            // What a thread cannot have, its children cannot have either. A user who may not even give rights up has
            // none.
            let _ = rustix::thread::remove_capability_from_bounding_set(CapabilitySet::SYS_NICE);
        }
        Started::of(&mut command)
    });
    thread.join().unwrap()
}

fn blueprints() -> Vec<String> {
    if number("DIMOS_SOAK_ALL", 0.0) == 0.0 {
        return ["coordinator-yourarm", "coordinator-dual-xarm", "remote"].map(str::to_owned).to_vec();
    }
    let folder = std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/blueprints")).unwrap();
    let names = folder.map(|entry| entry.unwrap().path().file_stem().unwrap().to_string_lossy().into_owned());
    names.chain(["remote".to_owned()]).collect()
}

/// How long one request moves an arm [s].
const LONGEST_MOTION: f64 = 120.0;

/// A computer that does not run a program for so long is too busy to judge anything on it: the cycle of a shim in
/// Python is several such waits, one after the other.
const STANDSTILL: Duration = Duration::from_millis(20);

/// Watches runs once, of each blueprint one idle and one moving: how long this computer stood still meanwhile for a
/// program like theirs, and what was held.
fn watched(names: &[String], realtime: bool, time: f64) -> (Duration, Vec<String>) {
    let start = |moving| names.iter().map(move |name| (moving, Soaked::start(name, realtime)));
    let runs: Vec<(bool, Soaked)> = start(false).chain(start(true)).collect();
    runs.iter().for_each(|(_, run)| run.up());
    let _busy = Busy::start(number("DIMOS_SOAK_BUSY", 8.0) as usize);
    // A shim is an ordinary program, whatever its run is.
    let watch = Watch::start(realtime && !names.iter().any(|name| name == "remote"));
    let (began, mut found) = (Instant::now(), Vec::new());
    loop {
        // One motion after the other, with a moment of rest between them: a request holds a few minutes at most.
        let left = time - began.elapsed().as_secs_f64();
        let moving = runs.iter().filter(|(moving, _)| *moving && left > 4.0);
        found.extend(moving.filter_map(|(_, run)| run.move_all(left.min(LONGEST_MOTION)).err()));
        std::thread::sleep(Duration::from_secs_f64(left.clamp(0.0, LONGEST_MOTION + 1.0)));
        if left <= LONGEST_MOTION + 1.0 || !found.is_empty() {
            break;
        }
    }
    let stalled = watch.stood_still();
    found.extend(runs.into_iter().flat_map(|(moving, run)| run.end(if moving { "moving" } else { "idle" })));
    (stalled, found)
}

fn soak(realtime: bool) {
    let time = number("DIMOS_SOAK", 10.0);
    let mut failures = Vec::new();
    let strict = std::env::var_os("DIMOS_SOAK").is_some();
    // A few at a time: all of them share two cores with the busy ones.
    for names in blueprints().chunks(3) {
        let mut found = Vec::new();
        for _ in 0..3 {
            let (stalled, held) = watched(names, realtime, time);
            found = held;
            // Nobody promises anything where not even a run's own threads get a processor.
            if found.is_empty() || strict || stalled < STANDSTILL {
                break;
            }
            println!("not judged: this computer was stalled for {stalled:?}: {found:?}");
            found.clear();
        }
        failures.extend(found);
    }
    assert!(failures.is_empty(), "{} holds:\n{}", failures.len(), failures.join("\n"));
}

#[test]
fn nothing_is_held_beside_busy_processes() {
    soak(true);
}

#[test]
fn nothing_is_held_beside_busy_processes_without_real_time() {
    soak(false);
}
