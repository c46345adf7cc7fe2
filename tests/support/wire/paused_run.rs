//! Runs of this program that are stopped for some milliseconds in a straight motion, and the judgement of each motion.

use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use dimos::hardware::registry::{AdapterConfig, AdapterSpec, EmulatorAddress};
use dimos::hardware::sim::faults::{Fault, FaultKind};
use dimos::robot::random::Random;
use dimos::rpc::api::{ArmEnable, ArmReset, Execute, Motion, Move, Point, Trajectory};
use dimos::rpc::client::Client;
use dimos::rpc::report::MotionReport;
use rustix::process::Pid;
use serde_json::{Value, json};

use super::paused::{Case, Emulated, Track, Way, emulator, model, pause, truth};
use super::watch::Watch;
use crate::support::arm_rows::Row;
use crate::support::loopback::own_address;
use crate::support::program::{Home, Started, eventually};

/// Off the line at the flange [m], where a robot is built in, else at a reach of 1 m [rad]; and back along it [rad].
/// Besides what a motion without a pause does.
const OFF: f64 = 0.002;
const BACK: f64 = 0.0005;
/// A pause during which this computer was stalled for longer is repeated, at most this many times.
const SPOILT: Duration = Duration::from_millis(2);
const REPETITIONS: usize = 5;

/// What happens to a motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Gap {
    None,
    Pause(Duration),
    /// Share of the messages that get lost.
    Loss(f64),
}

/// Figures of one length of pauses.
#[derive(Debug, Default, Clone)]
pub struct Figures {
    pub all: usize,
    pub completed: usize,
    pub off: f64,
    pub back: f64,
    /// Longest motion by its planned duration.
    pub ratio: f64,
    pub others: Vec<String>,
}

/// An emulator in this process, and a run in another.
pub struct Bed<'a> {
    pub case: &'a Case,
    pub row: AdapterSpec,
    pub model: &'static Row,
    pub emulator: Emulated,
    pub home: Home,
    pub run: Started,
    pub client: Client,
    pub random: Random,
}

impl<'a> Bed<'a> {
    pub fn new(case: &'a Case, loss: f64) -> Self {
        let row = *dimos::arms::registry().get(case.name).unwrap();
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
    pub fn play(&mut self, gap: Gap, times: usize, failures: &mut Vec<String>) -> Figures {
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
