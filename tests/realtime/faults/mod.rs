//! The faults of `docs/faults.md` that need a process, a wire or a real clock. A test's name begins with the id of its
//! fault. Each test prints what it measured. Faults that need none of these are in `tests/logic/faults`.
//! `DIMOS_REPEATS` is the number of measurements of a reaction time (3).

mod arms;
mod process;

use dimos::arms::yourarm::emulator::wire::Request;
use dimos::arms::yourarm::emulator::{Received, SimOptions, YourArmEmulator};
use dimos::clock::{Clock, Mono, MonotonicClock};
use dimos::hardware::registry::Emulator;
use dimos::robot::random::Random;
use serde_json::Value;

use crate::support::program::{Ended, Home, eventually};

const RUN: &str = "coordinator-yourarm";
/// Period of the shipped blueprint [s].
const PERIOD: f64 = 0.01;
/// Joint limits of the arm: top speeds [deg/s], acceleration [rad/s²].
const TOP_SPEED: [f64; 6] = [180.0, 180.0, 180.0, 360.0, 360.0, 360.0];
const ACCELERATION: f64 = 10.0;
/// Rounding error of an angle on the wire [deg]: half a step of an f32 near 270.
const ROUNDING: f64 = 1.6e-5;
/// Measurements of a reaction time. Their median is judged: a single one depends more on the machine than on the run.
fn repeats() -> usize {
    std::env::var("DIMOS_REPEATS").ok().and_then(|n| n.parse().ok()).unwrap_or(3)
}

fn now() -> Mono {
    MonotonicClock.now()
}

fn arm() -> YourArmEmulator {
    YourArmEmulator::with(&SimOptions::default()).unwrap()
}

/// Arguments for the shipped blueprint with this emulator, which outlives the run and records what it received.
fn at(arm: &YourArmEmulator) -> String {
    format!("{RUN} --set hardware.arm.address={}", arm.address())
}

/// Measures a reaction time several times, prints all figures [ms] and judges their median.
#[track_caller]
fn within(what: &str, limit_ms: f64, mut measure: impl FnMut() -> f64) {
    judge(what, limit_ms, (0..repeats()).map(|_| measure()).collect());
}

#[track_caller]
fn judge(what: &str, limit_ms: f64, mut figures: Vec<f64>) {
    figures.sort_by(f64::total_cmp);
    println!("{what}: {figures:.1?} ms (limit of the median {limit_ms} ms)");
    assert!(figures[figures.len() / 2] <= limit_ms, "{what}: {figures:.1?} ms, limit of the median {limit_ms} ms");
}

fn ms(from: Mono, to: Mono) -> f64 {
    to.seconds_since(from) * 1e3
}

/// The messages of some topics of a log, and how `replay` ended.
fn played(home: &Home, log: &str, topics: &str) -> (Vec<Value>, Ended) {
    let ended = home.dimos(&format!("replay {log} --json --rate 1000000 --topics {topics}"));
    (ended.out.lines().map(|line| serde_json::from_str(line).unwrap()).collect(), ended)
}

/// Setpoints in a trace [deg].
fn setpoints(trace: &[Received]) -> Vec<(Mono, [f64; 6])> {
    let one = |r: &Received| r.request.setpoint().map(|degrees| (r.at, degrees.map(f64::from)));
    trace.iter().filter_map(one).collect()
}

/// The largest velocity and acceleration of any joint on the wire, as fractions of their limits. After a gap of more
/// than two periods, when this computer was stalled, the arm has stopped, and setpoints begin from rest:
/// `wire_stalls` judges that.
fn wire_extremes(trace: &[Received]) -> (f64, f64) {
    let points = setpoints(trace);
    let (mut speed, mut change) = (0.0_f64, 0.0_f64);
    for w in points.windows(3) {
        let gap = w.windows(2).any(|pair| pair[1].0.seconds_since(pair[0].0) > 2.5 * PERIOD);
        for (j, top) in TOP_SPEED.iter().enumerate().filter(|_| !gap) {
            let (a, b) = (w[1].1[j] - w[0].1[j], w[2].1[j] - w[1].1[j]);
            speed = speed.max(((b.abs() - 2.0 * ROUNDING) / PERIOD) / top);
            let most = ACCELERATION.to_degrees() * PERIOD * PERIOD;
            change = change.max(((b - a).abs() - 4.0 * ROUNDING) / most);
        }
    }
    (speed, change)
}

/// Random numbers; the seed is printed, and `DIMOS_SEED` repeats a run.
fn random() -> Random {
    let given = std::env::var("DIMOS_SEED").ok().and_then(|s| s.parse().ok());
    let seed = given.unwrap_or_else(|| now().0);
    println!("DIMOS_SEED={seed}");
    Random::new(seed)
}

fn begin_long_move(home: &Home, arm: &YourArmEmulator) {
    home.dimos("move arm 2.5 -0.3 0.6 0 0.8 0 --speed 0.5 --no-wait").with(0);
    eventually("it moves", || arm.joints().1[0] > 0.5);
}
