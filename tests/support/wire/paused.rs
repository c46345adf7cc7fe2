//! Where an emulated arm truly goes beside a straight line of its joints, while the program that drives it is stopped.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use dimos::hardware::registry::{AdapterConfig, AdapterSpec, Emulator, EmulatorAddress};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

use super::arms::furthest;
use crate::support::arm_rows::{Row, rows};

/// An arm with its shipped rate [Hz], and two ends of a motion that is fast all the way [rad].
pub struct Case {
    pub name: &'static str,
    pub rate: f64,
    pub ends: [&'static [f64]; 2],
    pub options: &'static str,
    /// Messages of it can get lost.
    pub loses: bool,
}

pub type Emulated = Arc<Mutex<Box<dyn Emulator>>>;

/// The row for a coordinator, with the built-in robot.
pub fn model(name: &str) -> &'static Row {
    rows().iter().find(|row| row.name == name).unwrap()
}

pub fn emulator(row: &AdapterSpec, case: &Case, place: &EmulatorAddress, sim: Value) -> Emulated {
    let mut options: Value = serde_json::from_str(case.options).unwrap();
    for (key, value) in sim.as_object().unwrap() {
        options["sim"][key] = value.clone();
    }
    let dof = case.ends[0].len();
    let config = AdapterConfig { hardware_id: "arm".into(), address: "sim".into(), dof, options };
    Arc::new(Mutex::new(row.emulate.unwrap()(&config, place).unwrap()))
}

/// Where the joints truly are [rad].
pub fn truth(emulator: &Emulated, dof: usize) -> Vec<f64> {
    emulator.lock().unwrap().true_positions().unwrap()[..dof].to_vec()
}

/// The true joints over time [rad], from a thread.
pub struct Track {
    pub points: Arc<Mutex<Vec<Vec<f64>>>>,
    pub done: Arc<AtomicBool>,
}

/// How far from the straight line a motion went at the flange [m, or rad without a model], and how far back along it
/// [rad].
#[derive(Debug, Clone, Copy, Default)]
pub struct Way {
    pub off: f64,
    pub back: f64,
}

pub fn way(row: &Row, points: &[Vec<f64>], from: &[f64], to: &[f64]) -> Way {
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
pub fn apart(row: &Row, a: &[f64], b: &[f64]) -> f64 {
    let Some(robot) = &row.robot else { return furthest(a, b) };
    let flange = |q: &[f64]| {
        let mut frames = robot.kinematics.frames();
        robot.kinematics.forward(q, &mut frames);
        robot.kinematics.link_frame(robot.link, &frames).translation
    };
    (flange(a) - flange(b)).length()
}

impl Track {
    pub fn new() -> Self {
        Self { points: Arc::default(), done: Arc::default() }
    }

    /// Looks every millisecond, until it is done.
    pub fn look(&self, truth: impl Fn() -> Vec<f64>) {
        while !self.done.load(Ordering::Relaxed) {
            self.points.lock().unwrap().push(truth());
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    pub fn way(&self, row: &Row, from: &[f64], to: &[f64]) -> Way {
        self.done.store(true, Ordering::Relaxed);
        way(row, &self.points.lock().unwrap(), from, to)
    }
}

/// Stops a process; the time is that of its own clock, without the time that this thread was late.
pub fn pause(pid: Pid, time: Duration) {
    let began = Instant::now();
    kill_process(pid, Signal::STOP).unwrap();
    while began.elapsed() < time {
        std::hint::spin_loop();
    }
    kill_process(pid, Signal::CONT).unwrap();
}
