//! A run that is stopped for some milliseconds at full speed, at the rate of its shipped blueprint, and messages that
//! get lost: where the arm truly goes beside its straight line of the joints, and how the motion ends. pylibfranka
//! drives the emulated FR3 beside it. `make pauses` plays 25 of each; `DIMOS_WIRE_ARM=franka` only those of that arm.

use std::fmt::Write as _;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use dimos::hardware::registry::{AdapterConfig, AdapterSpec, Emulator, EmulatorAddress, Registry};
use dimos::hardware::sim::faults::{Fault, FaultKind};
use dimos::robot::random::Random;
use dimos::rpc::api::{ArmEnable, ArmReset, Execute, Motion, Move, Point, Trajectory};
use dimos::rpc::client::Client;
use dimos::rpc::report::MotionReport;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::{Value, json};

use crate::support::arm_rows::{Row, rows};
use crate::support::loopback::own_address;
use crate::support::program::{Home, Started, eventually};
use crate::support::python::python_with;
use crate::support::wire::arms::furthest;
use crate::support::wire::watch::Watch;

/// Off the line at the flange [m], where a robot is built in, else at a reach of 1 m [rad]; and back along it [rad].
/// Besides what a motion without a pause does.
const OFF: f64 = 0.002;
const BACK: f64 = 0.0005;
/// A pause during which this computer was stalled for longer is repeated, at most this many times.
const SPOILT: Duration = Duration::from_millis(2);
const REPETITIONS: usize = 5;

/// An arm with its shipped rate [Hz], and two ends of a motion that is fast all the way [rad].
struct Case {
    name: &'static str,
    rate: f64,
    ends: [&'static [f64]; 2],
    options: &'static str,
    /// Messages of it can get lost.
    loses: bool,
}

const CASES: [Case; 7] = [
    Case {
        name: "franka",
        rate: 1000.0,
        ends: [&[-1.0, -0.6, -0.8, -2.2, -0.8, 1.2, -1.0], &[1.0, 0.4, 0.8, -1.0, 0.8, 2.6, 1.0]],
        options: r#"{"model": "fr3"}"#,
        loses: true,
    },
    Case {
        name: "ur",
        rate: 250.0,
        ends: [&[-1.5, -1.4, 1.0, -1.5, -1.5, -1.5], &[1.5, -0.8, 1.9, 1.0, 0.5, 1.5]],
        options: "{}",
        loses: false,
    },
    Case {
        name: "xarm",
        rate: 100.0,
        ends: [&[-1.5, -0.6, -1.2, -1.5, 0.6, -1.5], &[1.5, 0.4, -0.4, 1.5, 1.6, 1.5]],
        options: r#"{"sim": {"tool_speed_factor": 10}}"#,
        loses: false,
    },
    Case {
        name: "piper",
        rate: 100.0,
        ends: [&[-1.5, 0.6, -1.6, -1.2, -0.8, -1.7], &[1.5, 1.6, -0.6, 1.2, 0.8, 1.7]],
        options: "{}",
        loses: true,
    },
    Case {
        name: "so101",
        rate: 100.0,
        ends: [&[-1.2, -1.0, -1.0, -1.0, -1.5], &[1.2, 1.0, 1.0, 1.0, 1.5]],
        options: "{}",
        loses: true,
    },
    Case {
        name: "yourarm",
        rate: 100.0,
        ends: [&[-1.5, -0.8, 0.2, -1.5, 0.2, -1.5], &[1.5, 0.4, 1.4, 1.5, 1.4, 1.5]],
        options: "{}",
        loses: false,
    },
    Case {
        name: "remote",
        rate: 100.0,
        ends: [&[-1.5, -0.8, 0.2, -1.5, 0.2, -1.5], &[1.5, 0.4, 1.4, 1.5, 1.4, 1.5]],
        options: "{}",
        loses: false,
    },
];

/// What happens to a motion.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Gap {
    None,
    Pause(Duration),
    /// Share of the messages that get lost.
    Loss(f64),
}

type Emulated = Arc<Mutex<Box<dyn Emulator>>>;

/// The row for a coordinator, with the built-in robot.
fn model(name: &str) -> &'static Row {
    rows().iter().find(|row| row.name == name).unwrap()
}

fn emulator(row: &AdapterSpec, case: &Case, place: &EmulatorAddress, sim: Value) -> Emulated {
    let mut options: Value = serde_json::from_str(case.options).unwrap();
    for (key, value) in sim.as_object().unwrap() {
        options["sim"][key] = value.clone();
    }
    let dof = case.ends[0].len();
    let config = AdapterConfig { hardware_id: "arm".into(), address: "sim".into(), dof, options };
    Arc::new(Mutex::new(row.emulate.unwrap()(&config, place).unwrap()))
}

/// Where the joints truly are [rad].
fn truth(emulator: &Emulated, dof: usize) -> Vec<f64> {
    emulator.lock().unwrap().true_positions().unwrap()[..dof].to_vec()
}

/// The true joints over time [rad], from a thread.
struct Track {
    points: Arc<Mutex<Vec<Vec<f64>>>>,
    done: Arc<AtomicBool>,
}

/// How far from the straight line a motion went at the flange [m, or rad without a model], and how far back along it
/// [rad].
#[derive(Debug, Clone, Copy, Default)]
struct Way {
    off: f64,
    back: f64,
}

fn way(row: &Row, points: &[Vec<f64>], from: &[f64], to: &[f64]) -> Way {
    let whole: f64 = from.iter().zip(to).map(|(a, b)| (b - a) * (b - a)).sum();
    let longest = furthest(from, to);
    let (mut way, mut best) = (Way::default(), f64::NEG_INFINITY);
    for q in points {
        let part = q.iter().zip(from).zip(to).map(|((q, a), b)| (q - a) * (b - a)).sum::<f64>() / whole;
        let line: Vec<f64> = from.iter().zip(to).map(|(a, b)| a + part * (b - a)).collect();
        best = part.max(best);
        way.off = way.off.max(apart(row, q, &line));
        way.back = way.back.max((best - part) * longest);
    }
    way
}

/// Distance of two poses at the flange [m], or of their furthest joints [rad].
fn apart(row: &Row, a: &[f64], b: &[f64]) -> f64 {
    let Some(robot) = &row.robot else { return furthest(a, b) };
    let flange = |q: &[f64]| {
        let mut frames = robot.kinematics.frames();
        robot.kinematics.forward(q, &mut frames);
        robot.kinematics.link_frame(robot.link, &frames).translation
    };
    (flange(a) - flange(b)).length()
}

impl Track {
    fn new() -> Self {
        Self { points: Arc::default(), done: Arc::default() }
    }

    /// Looks every millisecond, until it is done.
    fn look(&self, truth: impl Fn() -> Vec<f64>) {
        while !self.done.load(Ordering::Relaxed) {
            self.points.lock().unwrap().push(truth());
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    fn way(&self, row: &Row, from: &[f64], to: &[f64]) -> Way {
        self.done.store(true, Ordering::Relaxed);
        way(row, &self.points.lock().unwrap(), from, to)
    }
}

/// Stops a process; the time is that of its own clock, without the time that this thread was late.
fn pause(pid: Pid, time: Duration) {
    let began = Instant::now();
    kill_process(pid, Signal::STOP).unwrap();
    while began.elapsed() < time {
        std::hint::spin_loop();
    }
    kill_process(pid, Signal::CONT).unwrap();
}

/// Figures of one length of pauses.
#[derive(Debug, Default, Clone)]
struct Figures {
    all: usize,
    completed: usize,
    off: f64,
    back: f64,
    /// Longest motion by its planned duration.
    ratio: f64,
    others: Vec<String>,
}

/// An emulator in this process, and a run in another.
struct Bed<'a> {
    case: &'a Case,
    row: AdapterSpec,
    model: &'static Row,
    emulator: Emulated,
    home: Home,
    run: Started,
    client: Client,
    random: Random,
}

impl<'a> Bed<'a> {
    fn new(case: &'a Case, loss: f64) -> Self {
        let row = *Registry::builtin().get(case.name).unwrap();
        let mut start = case.ends[0].to_vec();
        start.extend((case.name == "so101").then_some(0.5));
        let mut sim = json!({ "initial_positions": start });
        if case.name == "franka" {
            sim["lose"] = json!(loss);
        }
        let place = match row.transport {
            "can" | "serial" => EmulatorAddress::Pty,
            _ => EmulatorAddress::Bind(own_address().into()),
        };
        let emulator = emulator(&row, case, &place, sim);
        let options: Value = serde_json::from_str(case.options).unwrap();
        let blueprint = json!({
            "coordinator": { "tick_rate": case.rate },
            "hardware": [{
                "hardware_id": "arm", "joints": { "prefix": "arm", "count": case.ends[0].len() },
                "adapter_type": case.name, "address": emulator.lock().unwrap().address(), "auto_enable": true, "options": options,
            }],
            "tasks": [{ "name": "traj_arm", "type": "trajectory", "joint_names": { "hardware": "arm" },
                "params": { "goal_tolerance": 0.05 } }],
        });
        let home = Home::new();
        home.write("pauses.yaml", &blueprint.to_string());
        let run = home.run("./pauses.yaml --no-record");
        let client = home.client();
        Self {
            case,
            row,
            model: model(case.name),
            emulator,
            home,
            run,
            client,
            random: Random::new(case.rate.to_bits()),
        }
    }

    fn arm(&self) -> Value {
        self.home.status()["arms"][0].clone()
    }

    fn ready(&mut self) {
        eventually("it is ready", || {
            let phase = self.arm()["phase"].clone();
            if phase != "ready" && phase != "activating" {
                let _ = self.client.call(ArmReset { arm: "arm".into() });
                let _ = self.client.call(ArmEnable::new("arm"));
            }
            phase == "ready"
        });
    }

    /// Goes to an end, from anywhere.
    fn return_to(&mut self, end: &[f64]) {
        for _ in 0..REPETITIONS {
            self.ready();
            let Ok(begun) = self.client.call(Move::new("arm", end, 0.5)) else { continue };
            let motion = begun.motion;
            eventually("it rests", || self.client.call(Motion { motion }).unwrap().done);
            if self.client.call(Motion { motion }).unwrap().state == "COMPLETED" {
                return;
            }
        }
        panic!("{}: it does not come to an end of its line: {}", self.case.name, self.arm());
    }

    /// As fast as the limits allow, from rest to rest on a line [s]; and how far a joint still goes where it brakes
    /// from its highest speed there [rad].
    fn seconds_and_braking(&self) -> (f64, f64) {
        let dof = self.case.ends[0].len();
        let options: Value = serde_json::from_str(self.case.options).unwrap();
        let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof, options };
        let limits = (self.row.check)(&config).unwrap().limits.with_defaults();
        let far: Vec<f64> = self.case.ends[0].iter().zip(self.case.ends[1]).map(|(a, b)| (b - a).abs()).collect();
        let (v, a) = (&limits.velocity_max, &limits.acceleration_max);
        let each = far.iter().enumerate().map(|(j, d)| (1.9 * d / v[j]).max((5.9 * d / a[j]).sqrt()));
        let seconds = 1.02 * each.fold(0.0, f64::max);
        let braking = far.iter().zip(a).map(|(d, a)| (1.9 * d / seconds).powi(2) / (2.0 * a));
        (seconds, braking.fold(0.0, f64::max))
    }

    /// A straight motion from an end to the other, and what comes between. Returns its report, its way, and why the arm
    /// is held.
    fn go(&mut self, from: &[f64], to: &[f64], gap: Gap, seconds: f64) -> (MotionReport, Way, String) {
        self.ready();
        std::thread::sleep(Duration::from_millis(200));
        let (emulator, dof) = (self.emulator.clone(), from.len());
        let (track, at) = (Track::new(), self.random.between(0.05, 0.9) * seconds);
        let still = vec![0.0; dof];
        let point = |time_from_start: f64, positions: &[f64]| Point {
            time_from_start,
            positions: positions.to_vec(),
            velocities: Some(still.clone()),
            accelerations: Some(still.clone()),
        };
        let trajectory = Trajectory {
            joint_names: (1..=dof).map(|j| format!("arm_joint{j}")).collect(),
            points: vec![point(0.0, from), point(seconds, to)],
        };
        let execute = Execute { trajectory, task: None, retraces_to: None };
        let motion = match self.client.call(execute.clone()) {
            Ok(begun) => begun.motion,
            // It was held at rest meanwhile, on a busy computer.
            Err(_) => {
                self.return_to(from);
                self.client.call(execute).unwrap_or_else(|e| panic!("{}: {e}", self.case.name)).motion
            }
        };
        let pid = Pid::from_raw(self.run.pid() as i32).unwrap();
        let report = std::thread::scope(|scope| {
            scope.spawn(|| track.look(|| truth(&emulator, dof)));
            std::thread::sleep(Duration::from_secs_f64(at));
            if let Gap::Pause(time) = gap {
                pause(pid, time);
            }
            loop {
                let report = self.client.call(Motion { motion }).unwrap();
                if report.done || report.elapsed > 20.0 {
                    track.done.store(true, Ordering::Relaxed);
                    break report;
                }
                if let Gap::Loss(share) = gap {
                    self.lose(share);
                }
                std::thread::sleep(Duration::from_millis(3));
            }
        });
        let arm = self.arm();
        let cause = format!(
            "{} ({})",
            arm["phase"].as_str().unwrap_or_default(),
            arm["cause"]["name"].as_str().unwrap_or_default()
        );
        (report, track.way(self.model, from, to), cause)
    }

    /// Loses commands of CAN and servos, and servos' replies, at a share of those that come in 3 ms.
    fn lose(&mut self, share: f64) {
        let each = [(FaultKind::LostCommand, 3.0 * 0.1), (FaultKind::Silent, 3.0 * 0.2)];
        for (kind, messages) in each {
            if self.random.unit() < share * messages && (kind == FaultKind::LostCommand || self.case.name == "so101") {
                let _ = self.emulator.lock().unwrap().inject(Fault::new(kind));
            }
        }
    }

    /// Plays motions there and back with the same kind of gap, and judges each.
    fn play(&mut self, gap: Gap, times: usize, failures: &mut Vec<String>) -> Figures {
        let [a, b] = self.case.ends;
        // The kernel passes on the bytes of a pseudo-terminal in an ordinary thread.
        let serial = matches!(self.row.transport, "can" | "serial");
        let watch = if serial { Watch::of_programs() } else { Watch::of_emulators() };
        let mut figures = Figures::default();
        let (seconds, braking) = self.seconds_and_braking();
        self.return_to(a);
        let (first, clean, _) = self.go(a, b, Gap::None, seconds);
        if first.state != "COMPLETED" {
            failures
                .push(format!("{}: without a gap the motion is {}: {:?}", self.case.name, first.state, first.error));
        }
        let mut at_b = true;
        for _ in 0..times {
            for repetition in 0..REPETITIONS {
                let (from, to) = if at_b { (b, a) } else { (a, b) };
                let began = Instant::now();
                let (report, way, cause) = self.go(from, to, gap, seconds);
                if report.state != "COMPLETED" {
                    self.return_to(to);
                }
                at_b = !at_b;
                let found = self.judge(gap, &report, way, (clean, braking), &cause, seconds);
                if !found.is_empty() && watch.longest_since(began) > SPOILT && repetition + 1 < REPETITIONS {
                    continue;
                }
                figures.all += 1;
                if report.state == "COMPLETED" {
                    figures.completed += 1;
                    (figures.off, figures.back) = (figures.off.max(way.off), figures.back.max(way.back));
                    figures.ratio = figures.ratio.max(report.elapsed / seconds);
                } else {
                    figures.others.push(cause.clone());
                }
                failures.extend(found.into_iter().map(|f| format!("{} {gap:?}: {f}", self.case.name)));
                break;
            }
        }
        figures
    }

    fn judge(
        &self,
        gap: Gap,
        report: &MotionReport,
        way: Way,
        own: (Way, f64),
        cause: &str,
        seconds: f64,
    ) -> Vec<String> {
        let (mut found, (clean, braking)) = (Vec::new(), own);
        let period = 1.0 / self.case.rate;
        let tolerance = self.row.gap_tolerance.as_secs_f64().max(2.0 * period);
        let pause = if let Gap::Pause(pause) = gap { pause.as_secs_f64() } else { 0.0 };
        let (bridged, beyond) = (pause + period + 5e-4 <= tolerance, pause > tolerance);
        let completed = report.state == "COMPLETED";
        // A controller that ends the motion itself, a gap that the run reports, a run that lost 0.1 s.
        let own = self.case.name == "franka" && !bridged && cause.contains("fault");
        let honest = completed
            || own
            || (!bridged && cause.contains("gap"))
            || (pause + period > 0.099 && cause.contains("overrun"));
        if !honest || (bridged && !completed) {
            found.push(format!("{}, {cause}: {:?}", report.state, report.error));
        }
        if !own {
            // A joint at speed whose setpoints end brakes behind the last of them, and comes back.
            let by_itself = if bridged || gap == Gap::None || self.case.name == "ur" { 0.0 } else { braking };
            let most = (clean.off + OFF + by_itself, clean.back + BACK + by_itself);
            if way.off > most.0 {
                found.push(format!(
                    "{:.2} mm (mrad) off its line (without a pause {:.2})",
                    1e3 * way.off,
                    1e3 * clean.off
                ));
            }
            if way.back > most.1 {
                found.push(format!("{:.2} mrad back (without a pause {:.2})", 1e3 * way.back, 1e3 * clean.back));
            }
        }
        let rests = if beyond { 0.5 } else { 0.0 };
        let late = report.elapsed - (1.3 * seconds + rests + pause);
        if completed && gap != Gap::None && late > 0.0 && !matches!(gap, Gap::Loss(_)) {
            found.push(format!("it took {:.3} s, planned {seconds:.3} s", report.elapsed));
        }
        found
    }
}

/// pylibfranka's motions on the same emulated arm, paused in the same way.
struct Peer {
    emulator: Emulated,
    client: Child,
    lines: std::io::Lines<BufReader<std::process::ChildStdout>>,
    random: Random,
}

impl Peer {
    fn new(python: &Path) -> Self {
        let (row, case, address) = (*Registry::builtin().get("franka").unwrap(), &CASES[0], own_address());
        let sim = json!({ "initial_positions": case.ends[0] });
        let emulator = emulator(&row, case, &EmulatorAddress::Bind(address.into()), sim);
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/franka_pauses.py");
        let mut command = Command::new(python);
        command.arg(script).arg(address.to_string()).env("PYTHONDONTWRITEBYTECODE", "1");
        let mut client = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let lines = BufReader::new(client.stdout.take().unwrap()).lines();
        Self { emulator, client, lines, random: Random::new(7) }
    }

    /// A motion; whether it ended as it should, and its way.
    fn go(&mut self, to: &[f64], time: Duration) -> (bool, Way) {
        let emulator = self.emulator.clone();
        let (from, track) = (truth(&emulator, 7), Track::new());
        let words: Vec<String> = to.iter().map(f64::to_string).collect();
        writeln!(self.client.stdin.as_mut().unwrap(), "{}", words.join(" ")).unwrap();
        let begun = self.lines.next().unwrap().unwrap();
        let seconds: f64 = begun.strip_prefix("begun ").unwrap().parse().unwrap();
        let at = self.random.between(0.05, 0.9) * seconds;
        let pid = Pid::from_raw(self.client.id() as i32).unwrap();
        let lines = &mut self.lines;
        let ended = std::thread::scope(|scope| {
            scope.spawn(|| track.look(|| truth(&emulator, 7)));
            std::thread::sleep(Duration::from_secs_f64(at));
            if !time.is_zero() {
                pause(pid, time);
            }
            let ended = lines.next().unwrap().unwrap();
            track.done.store(true, Ordering::Relaxed);
            ended
        });
        (ended == "done", track.way(model("franka"), &from, to))
    }

    fn play(&mut self, time: Duration, times: usize) -> Figures {
        let mut figures = Figures::default();
        let [a, b] = CASES[0].ends;
        for i in 0..times {
            let (done, way) = self.go(if i % 2 == 0 { b } else { a }, time);
            figures.all += 1;
            figures.completed += usize::from(done);
            if done {
                (figures.off, figures.back) = (figures.off.max(way.off), figures.back.max(way.back));
            } else {
                self.go(if i % 2 == 0 { b } else { a }, Duration::ZERO);
            }
        }
        figures
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        drop(self.client.stdin.take());
        let _ = self.client.wait();
    }
}

fn row(name: &str, gap: &str, figures: &Figures) -> String {
    let mut row = format!(
        "| {name} | {gap} | {} of {} | {:.2} | {:.2} | {:.2} |",
        figures.completed,
        figures.all,
        1e3 * figures.off,
        1e3 * figures.back,
        figures.ratio
    );
    if let Some(first) = figures.others.first() {
        let _ = write!(row, " else {first}");
    }
    row
}

/// Plays all gaps of an arm. Returns rows of the table, and what broke a rule.
fn play(case: &Case, pauses: &[u64], many: Option<usize>) -> (Vec<String>, Vec<String>) {
    let (mut table, mut failures, times) = (Vec::new(), Vec::new(), many.unwrap_or(1));
    let mut bed = Bed::new(case, 0.0);
    for ms in pauses {
        let figures = bed.play(Gap::Pause(Duration::from_millis(*ms)), times, &mut failures);
        table.push(row(case.name, &format!("{ms} ms"), &figures));
    }
    for share in [0.005, 0.02].into_iter().filter(|_| case.loses && many.is_some()) {
        let mut bed = Bed::new(case, if case.name == "franka" { share } else { 0.0 });
        let figures = bed.play(Gap::Loss(share), times, &mut failures);
        table.push(row(case.name, &format!("{} % lost", 100.0 * share), &figures));
    }
    (table, failures)
}

#[test]
fn pauses_on_the_wire_leave_arms_on_their_lines() {
    let many = std::env::var("DIMOS_WIRE_PAUSES").ok().and_then(|n| n.parse().ok());
    let pauses: &[u64] = if many.is_some() { &[2, 5, 8, 12, 19, 25, 50, 90] } else { &[5, 12, 50] };
    let times = many.unwrap_or(1);
    let only = std::env::var("DIMOS_WIRE_ARM").ok();
    let chosen = |case: &&Case| only.as_ref().is_none_or(|only| only == case.name);
    let (mut failures, mut table) = (Vec::new(), Vec::new());
    // Arms with a setpoint every 10 ms side by side; the others, which want theirs in time, alone.
    std::thread::scope(|scope| {
        let slow = CASES.iter().filter(chosen).filter(|case| case.rate <= 100.0);
        let threads: Vec<_> = slow.map(|case| scope.spawn(|| play(case, pauses, many))).collect();
        for (rows, found) in threads.into_iter().map(|thread| thread.join().unwrap()) {
            table.extend(rows);
            failures.extend(found);
        }
    });
    for case in CASES.iter().filter(chosen).filter(|case| case.rate > 100.0) {
        let (rows, found) = play(case, pauses, many);
        table.extend(rows);
        failures.extend(found);
    }
    if only.is_none_or(|only| only == "franka")
        && let Some(python) = python_with(&["pylibfranka"])
    {
        let mut peer = Peer::new(&python);
        for ms in pauses {
            let figures = peer.play(Duration::from_millis(*ms), times);
            table.push(row("pylibfranka", &format!("{ms} ms"), &figures));
        }
    }
    println!(
        "| arm | gap | completed | off its line [mm, mrad] | back [mrad] | of its planned time |\n|---|---|---|---|---|---|"
    );
    table.iter().for_each(|row| println!("{row}"));
    assert!(failures.is_empty(), "{} failures:\n{}", failures.len(), failures.join("\n"));
}
