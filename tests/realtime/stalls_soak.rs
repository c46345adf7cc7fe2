//! `make soak`: runs with simulated arms, idle and moving at the same time, beside busy processes, with and without
//! real-time permission: no arm is held. Only a hold at which a processor ran no program at all for 100 ms (the host of
//! a virtual machine did not schedule it) is not counted: it is printed, the arm is reset, and the soak continues.
//! Every other hold fails it; how long an ordinary thread of the test waited for a processor at that time is printed.
//! `DIMOS_SOAK` is the duration [s] (5), `DIMOS_SOAK_BUSY` the number of busy processes (8), `DIMOS_SOAK_ALL=1` takes
//! every shipped blueprint.

use std::collections::{HashMap, HashSet};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant, SystemTime};

use dimos::rpc::api::{ArmEnable, ArmReset, Execute, Point, State, Status, Trajectory};
use dimos::rpc::client::Client;
use rustix::process::Signal;
use rustix::thread::CapabilitySet;

use crate::support::busy::Busy;
use crate::support::program::{Home, Started, UP};
use crate::support::wire::watch::{Delay, HOLDS, Watch};

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
    /// Requested motions, and those of them that began.
    turns: usize,
    moved: usize,
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
        Self {
            name: name.to_owned(),
            realtime,
            turns: 0,
            moved: 0,
            run: Some(started(command, realtime)),
            home,
            _shim: shim,
        }
    }

    fn up(&self) {
        self.run.as_ref().unwrap().until(UP);
    }

    /// Swings every joint by 0.2 rad for this time [s]. A hold in this moment refuses the motion; it counts.
    fn turn(&mut self, seconds: f64) {
        self.turns += 1;
        match self.move_all(seconds) {
            Ok(()) => self.moved += 1,
            Err(refused) => println!("{refused}"),
        }
    }

    /// One trajectory per task: that of two arms gets one for both.
    fn move_all(&self, seconds: f64) -> Result<(), String> {
        let mut client: Client = self.home.client();
        let (status, state) = (client.call(Status {}).unwrap(), client.call(State {}).unwrap());
        let mut ranged: HashMap<&str, (f64, [f64; 2])> = HashMap::new();
        for (arm, ranges) in state.arms.iter().zip(status.arms.iter().map(|arm| &arm.position_limits)) {
            assert_eq!(arm.joints.len(), ranges.len(), "{}: {}", self.name, arm.hardware_id);
            let starts = arm.joints.iter().map(|joint| (&*joint.name, joint.command.or(joint.position).unwrap()));
            ranged.extend(starts.zip(ranges).map(|((joint, start), range)| (joint, (start, *range))));
        }
        let mut moved = HashSet::new();
        for task in status.tasks.iter().filter(|task| task.takes.iter().any(|method| method == "execute")) {
            if task.joints.iter().any(|joint| moved.contains(joint)) {
                continue;
            }
            moved.extend(&task.joints);
            let start: Vec<f64> = task.joints.iter().map(|joint| ranged[&**joint].0).collect();
            let inwards: Vec<f64> =
                task.joints.iter().map(|joint| ranged[&**joint]).map(|(q, r)| inwards(q, r)).collect();
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
            let trajectory = Trajectory { joint_names: task.joints.clone(), points: points.collect() };
            let task = Some(task.name.clone());
            client.call(Execute { trajectory, task, retraces_to: None }).map_err(|e| format!("{}: {e}", self.name))?;
        }
        assert_eq!(moved.len(), ranged.len(), "{}: every joint moves: {moved:?}", self.name);
        Ok(())
    }

    /// Makes held arms ready again, so that the soak continues.
    fn recover(&self) {
        let mut client: Client = self.home.client();
        for arm in self.home.status()["arms"].as_array().unwrap().iter().filter(|arm| arm["phase"] != "ready") {
            let arm = arm["hardware_id"].as_str().unwrap();
            // A refusal shows as the next hold.
            let _ = client.call(ArmReset { arm: arm.into() });
            let _ = client.call(ArmEnable::new(arm));
        }
    }

    /// Returns a failure if fewer than half of its motions began: then the soak has judged no moving arm.
    fn idle(&self) -> Option<String> {
        (2 * self.moved < self.turns).then(|| format!("{}: {} of {} motions began", self.name, self.moved, self.turns))
    }

    /// Shuts it down. Returns what held an arm, and when.
    fn end(mut self, what: &str) -> Vec<Hold> {
        let status = self.home.status();
        assert!(self.realtime || status["realtime"][0]["granted"] == false, "{}", status["realtime"]);
        let name = format!("{} {what}", self.name);
        let ended = self.run.take().unwrap().end(Signal::INT);
        let hold = |line: &str| {
            let at: jiff::Timestamp = line.split(' ').next().unwrap().parse().unwrap();
            Hold { at: at.into(), what: format!("{name}: {line}") }
        };
        ended.err.lines().filter(|line| line.contains("is held")).map(hold).collect()
    }
}

/// Half the swing of a joint at `start` [rad], to the side with more room in its range.
fn inwards(start: f64, [lower, upper]: [f64; 2]) -> f64 {
    if upper - start < start - lower { -0.1 } else { 0.1 }
}

/// An arm was held.
struct Hold {
    at: SystemTime,
    what: String,
}

impl Hold {
    /// A processor that runs nothing for this time must hold an arm.
    const LIMIT: Duration = HOLDS;
    /// The last effects of a stall are logged this much later: states of a remote arm are valid for 200 ms, and the
    /// text log is written by an ordinary thread.
    const AFTER: Duration = Duration::from_secs(1);

    /// Returns the stall that explains it.
    fn cause<'s>(&self, stalls: &'s [Delay]) -> Option<&'s Delay> {
        stalls.iter().find(|stall| stall.ended - stall.length <= self.at && self.at <= stall.ended + Self::AFTER)
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

/// Watches runs, of each blueprint one idle and one moving. Returns what was held; adds to `idle` what did not move.
fn watched(names: &[String], realtime: bool, time: f64, idle: &mut Vec<String>) -> Vec<Hold> {
    let start = |moving| names.iter().map(move |name| (moving, Soaked::start(name, realtime)));
    let mut runs: Vec<(bool, Soaked)> = start(false).chain(start(true)).collect();
    runs.iter().for_each(|(_, run)| run.up());
    let _busy = Busy::start(number("DIMOS_SOAK_BUSY", 8.0) as usize);
    let began = Instant::now();
    loop {
        let left = time - began.elapsed().as_secs_f64();
        if left <= 4.0 {
            break;
        }
        for (_, run) in runs.iter_mut().filter(|(moving, _)| *moving) {
            run.turn(left.min(LONGEST_MOTION));
        }
        std::thread::sleep(Duration::from_secs_f64(left.min(LONGEST_MOTION + 1.0)));
        runs.iter().for_each(|(_, run)| run.recover());
    }
    idle.extend(runs.iter().filter_map(|(_, run)| run.idle()));
    runs.into_iter().flat_map(|(moving, run)| run.end(if moving { "moving" } else { "idle" })).collect()
}

fn soak(realtime: bool) {
    let (host, ordinary) = (Watch::of_processors(), Watch::of_ordinary_threads());
    let time = number("DIMOS_SOAK", 5.0);
    // A few at a time: all of them share two cores with the busy ones.
    let (mut holds, mut idle) = (Vec::new(), Vec::new());
    blueprints().chunks(3).for_each(|names| holds.extend(watched(names, realtime, time, &mut idle)));
    let stalls = host.delays(Hold::LIMIT);
    for stall in &stalls {
        let ended = jiff::Timestamp::try_from(stall.ended).unwrap();
        println!("a processor ran nothing for {:?} until {ended}", stall.length);
    }
    let (explained, failures): (Vec<_>, Vec<_>) = holds.iter().partition(|hold| hold.cause(&stalls).is_some());
    for hold in explained {
        println!("not counted, a processor ran nothing for {:?}: {}", hold.cause(&stalls).unwrap().length, hold.what);
    }
    let (shorter, waits) = (host.delays(Duration::ZERO), ordinary.delays(Duration::ZERO));
    for hold in &failures {
        let longest = |delays: &[Delay]| {
            let near = delays.iter().filter(|delay| hold.cause(std::slice::from_ref(delay)).is_some());
            near.map(|delay| delay.length).max().unwrap_or_default()
        };
        println!("{}", hold.what);
        println!(
            "  before it a processor ran nothing for {:?}, an ordinary thread waited for {:?}",
            longest(&shorter),
            longest(&waits)
        );
    }
    assert!(failures.is_empty() && idle.is_empty(), "{} holds, see above; {idle:?}", failures.len());
}

#[test]
fn a_joint_swings_inside_its_range() {
    // Joint 3 of an xArm a little below zero, and a Piper's joint at the end of its range.
    assert_eq!(inwards(-0.02, [-3.81, 0.165]), -0.1);
    assert_eq!(inwards(0.0, [-2.97, 0.0]), -0.1);
    assert_eq!(inwards(0.0, [0.0, 3.0]), 0.1);
}

#[test]
fn nothing_is_held_beside_busy_processes() {
    soak(true);
}

#[test]
fn nothing_is_held_beside_busy_processes_without_real_time() {
    soak(false);
}
