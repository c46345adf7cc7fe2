//! A stall of the computer is no fault of the arm: a run that is stopped and continued at full speed, with its emulator
//! or alone, finishes its motion. Its commands are judged on the wire. `DIMOS_STALLS=200` is the number of stops.

use std::sync::Arc;
use std::time::{Duration, Instant};

use dimos::rpc::api::{ArmEnable, ArmReset, Cancel, Motion, Move};
use dimos::rpc::client::Client;
use dimos::rpc::report::MotionReport;
use rustix::process::Signal;

use crate::support::loopback::own_address;
use crate::support::program;
use crate::support::program::{Home, Started, eventually};
use crate::support::wire::arms::{PERIOD, YOURARM, furthest};
use crate::support::wire::decode;
use crate::support::wire::judge::Bounds;
use crate::support::wire::stream::Proxy;
use crate::support::wire::watch::Watch;
use crate::support::wire::{Gate, now};

/// A stop that took longer than planned, on a busy computer, is no longer a short one.
const LONGEST: Duration = Duration::from_millis(95);
/// Top speeds of the arm's joints [rad/s], and their acceleration [rad/s²], from its sheet.
const TOP_SPEED: [f64; 6] = [180.0, 180.0, 180.0, 360.0, 360.0, 360.0];
const ACCELERATION: f64 = 10.0;

fn times() -> usize {
    std::env::var("DIMOS_STALLS").ok().and_then(|n| n.parse().ok()).unwrap_or(2)
}

/// The emulator in its own process, the wire in this one, and a run in a third.
struct Three {
    home: Home,
    run: Started,
    emulator: Started,
    gate: Gate,
    client: Client,
    _proxy: Proxy,
}

impl Three {
    fn start() -> Self {
        let (home, address) = (Home::new(), own_address());
        let emulator = home.start(&format!("adapter emulate yourarm --bind {address}"));
        emulator.until("Ctrl-C ends it");
        let gate = Gate::new(Arc::new(Vec::new));
        let proxy = Proxy::tcp(&format!("{address}:9760"), &gate, decode::yourarm());
        let blueprint = format!("coordinator-yourarm --no-record --set hardware.arm.address={}", proxy.address);
        let run = home.run(&blueprint);
        let client = home.client();
        let mut three = Self { home, run, emulator, gate, client, _proxy: proxy };
        three.ready();
        three
    }

    fn phase(&self) -> String {
        self.home.status()["arms"][0]["phase"].as_str().unwrap().to_owned()
    }

    fn ready(&mut self) {
        eventually("it is ready", || {
            let ready = self.phase() == "ready";
            if !ready {
                // It is this client that has the arm.
                let _ = self.client.call(ArmReset { arm: "arm".into() });
                let _ = self.client.call(ArmEnable::new("arm"));
            }
            ready
        });
    }

    /// Begins a motion from one end to the other, and waits until it has its full speed.
    fn at_full_speed(&mut self) -> u64 {
        let here = self.home.positions("arm");
        let [near, far] = YOURARM.near_and_far(&here);
        let go = |target: &[f64]| Move::new("arm", target, 1.0);
        if furthest(near, &here) > 0.2 {
            let motion = self.begin(go(near));
            self.done(motion);
            self.ready();
            self.gate.forget();
        }
        let motion = self.begin(go(far));
        let began = Instant::now();
        let fast =
            |gate: &Gate| gate.speed(PERIOD).iter().zip(TOP_SPEED).any(|(v, top)| v.abs() > 0.9 * top.to_radians());
        while !fast(&self.gate) {
            assert!(began.elapsed() < program::TIMEOUT, "it does not move: {}", self.phase());
            std::thread::sleep(Duration::from_millis(2));
        }
        motion
    }

    /// Begins a motion.
    fn begin(&mut self, motion: Move) -> u64 {
        Watch::shared().unless_stalled(|| {
            self.ready();
            self.client.call(motion.clone()).map(|begun| begun.motion).map_err(|e| e.to_string())
        })
    }

    /// Waits for the end of a motion; returns its report.
    fn done(&mut self, motion: u64) -> MotionReport {
        loop {
            let report = self.client.call(Motion { motion }).unwrap();
            if report.done {
                return report;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

fn bounds() -> Bounds {
    Bounds {
        velocity: TOP_SPEED.map(f64::to_radians).to_vec(),
        acceleration: vec![ACCELERATION; 6],
        period: PERIOD,
        rounding: YOURARM.rounding,
        stale_after: YOURARM.stale_after(),
        stopped_within: None,
        time_limit: YOURARM.time_limit,
    }
}

/// Stops processes for this time; returns how long it took.
fn stop(processes: &[&Started], time: Duration) -> Duration {
    let began = Instant::now();
    processes.iter().for_each(|p| p.signal(Signal::STOP));
    std::thread::sleep(time);
    processes.iter().for_each(|p| p.signal(Signal::CONT));
    began.elapsed()
}

/// Between 20 and 90 ms, spread evenly over any number of stops.
fn spread(i: usize) -> Duration {
    Duration::from_millis(20 + (70.0 * (i as f64 * 0.618).fract()) as u64)
}

/// Stops a run at full speed several times for less than 0.1 s, then once for longer. `again`: after each of the short
/// stops, this much later, another of 40 ms.
fn stopped_repeatedly(with_emulator: bool, again: Option<Duration>) {
    let mut three = Three::start();
    let (mut held, mut failures) = (0, Vec::new());
    for i in 0..times() {
        three.gate.forget();
        let motion = three.at_full_speed();
        let (began, time) = (now(), spread(i));
        let emulator = with_emulator.then_some(&three.emulator);
        let stopped = [&three.run].into_iter().chain(emulator).collect::<Vec<_>>();
        let mut took = stop(&stopped, time);
        if let Some(later) = again {
            std::thread::sleep(later);
            took = took.max(stop(&stopped, Duration::from_millis(40)));
        }
        let report = three.done(motion);
        let (sent, delivered) = (three.gate.sent(), three.gate.delivered());
        let wire = bounds().neighbours(&sent, began).and_then(|()| bounds().windows(&delivered, began));
        failures.extend(wire.err().map(|e| format!("stopped for {time:?}: {e}")));
        if report.state != "COMPLETED" {
            let arm = three.home.status()["arms"][0].clone();
            println!("stopped for {time:?} ({took:?}): {:?}, {} {}", report.error, arm["phase"], arm["cause"]);
            println!("{}", three.run.err());
            held += usize::from(took < LONGEST);
        }
        three.ready();
    }
    if held > 0 {
        failures.push(format!("{held} of {} short stops ended the motion", times()));
    }
    // A stall of this length is a fault.
    three.at_full_speed();
    let emulator = with_emulator.then_some(&three.emulator);
    stop(&[&three.run].into_iter().chain(emulator).collect::<Vec<_>>(), Duration::from_millis(150));
    std::thread::sleep(Duration::from_millis(300));
    if three.phase() != "held" {
        failures.push(format!("it is {} after 150 ms without a tick", three.phase()));
    }
    assert!(failures.is_empty(), "{}", failures.join("\n"));
}

#[test]
fn a_run_that_is_stopped_with_its_emulator_goes_on() {
    stopped_repeatedly(true, None);
}

#[test]
fn a_run_that_is_stopped_alone_goes_on() {
    stopped_repeatedly(false, None);
}

/// The arm still coasts from the first stop when the second begins.
#[test]
fn a_run_that_is_stopped_twice_in_a_row_goes_on() {
    stopped_repeatedly(false, Some(Duration::from_millis(60)));
}

#[test]
fn an_emulator_that_is_stopped_alone_holds_the_arm() {
    let mut three = Three::start();
    // A run does not count its own delays as silence of the arm. A turn in which this computer lost a period is not
    // judged if the arm is not held; every other turn is.
    let host = Watch::shared();
    for _ in 0..5 {
        three.ready();
        three.at_full_speed();
        let began = Instant::now();
        stop(&[&three.emulator], Duration::from_secs_f64(YOURARM.stale_after() + 0.02));
        std::thread::sleep(Duration::from_millis(200));
        let (phase, lost) = (three.phase(), host.lost_since(began, Duration::ZERO));
        if phase == "held" {
            return;
        }
        let what = format!("it is {phase} after its arm was silent for 20 ms longer than it may be");
        assert!(lost.as_secs_f64() >= PERIOD, "{what} (this computer lost {lost:?})");
        println!("not judged, this computer lost {lost:?}: {what}");
        let _ = three.client.call(Cancel::default());
    }
    panic!("this computer was stalled in every turn");
}
