//! `make bench`: cost of talking to a run: a stop during a flood of requests, the round trip, and the effect of readers
//! on the tick, what `dimos proxy` adds, and plans from request to result. Prints and judges figures; no figure fails
//! it. `cargo bench --bench rpc -- stops` measures stops only; the other parts: `proxy plans worlds round-trip readers
//! python`.

mod plans;
mod proxy;
mod stops;
#[path = "../support/mod.rs"]
#[allow(dead_code, reason = "shared with the other benchmarks")]
mod support;

use std::process::{Command, ExitCode};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use dimos::rpc::api::{State, Status};
use dimos::rpc::client::Client;
use dimos::rpc::server::streams::{Stream, Subscribe};
use support::measure::{Goal, Measure, print, quantile};
use support::run::LiveRun;
use support::{Effort, machine};

/// Readers of the joint state at the tick's rate.
const READERS: usize = 4;
/// Requests per second in the flood.
const FLOOD: f64 = 10_000.0;

/// A part of the benchmark, by name.
type Part = (&'static str, fn(Effort) -> Result<(), String>);

fn main() -> ExitCode {
    let effort = Effort::from_environment();
    println!("\ndimos: cost of talking to a run{}\n", effort.of(" (quick)", ""));
    machine::print();
    let parts: [Part; 7] = [
        ("stops", stops::measure),
        ("proxy", proxy::measure),
        ("plans", plans::measure),
        ("worlds", plans::worlds),
        ("round-trip", round_trip),
        ("readers", readers),
        ("python", python),
    ];
    let named: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    for (name, part) in parts {
        if (named.is_empty() || named.iter().any(|n| n == name))
            && let Err(why) = part(effort)
        {
            support::skipped(&format!("{name}: {why}"));
        }
    }
    effort.end()
}

/// Starts a run whose tick is 1 kHz.
fn fast_run() -> Result<LiveRun, String> {
    LiveRun::start("coordinator-mock", &["--set", "coordinator.tick_rate=1000"]).map_err(|e| e.to_string())
}

/// Measures request and reply of `state`, one after the other.
fn round_trip(effort: Effort) -> Result<(), String> {
    let (mut p50, mut p99) = (Vec::new(), Vec::new());
    for _ in 0..effort.of(1, 5) {
        let mut run = fast_run()?;
        let mut client = run.client()?;
        let times: Result<Vec<f64>, String> = (0..effort.of(200, 10_000))
            .map(|_| {
                let began = Instant::now();
                client.call(State {}).map_err(|e| e.to_string())?;
                Ok(began.elapsed().as_secs_f64() * 1e6)
            })
            .collect();
        let times = times?;
        p50.push(quantile(&times, 0.5));
        p99.push(quantile(&times, 0.99));
    }
    print(
        "round trip of `state`, coordinator-mock at 1 kHz",
        &[
            Measure::new("p50", "µs", p50).goal(Goal::AtMost(60.0)),
            Measure::new("p99", "µs", p99).goal(Goal::AtMost(300.0)),
        ],
    );
    Ok(())
}

/// Measures the lateness of the tick alone, with readers of the stream, and in a flood of requests, in turns.
fn readers(effort: Effort) -> Result<(), String> {
    let time = Duration::from_secs(effort.of(1, 10));
    let (mut alone, mut read, mut flooded) = (Vec::new(), Vec::new(), Vec::new());
    for _ in 0..effort.of(1, 5) {
        alone.push(lateness(time, |_| Ok(Vec::new()))?);
        read.push(lateness(time, |stop| (0..READERS).map(|_| Ok(reader(stop))).collect())?);
        flooded.push(lateness(time, |stop| Ok(vec![flood(stop)]))?);
    }
    let ratio = |with: &[f64]| with.iter().zip(&alone).map(|(w, a)| w / a).collect::<Vec<_>>();
    let (read_ratio, flood_ratio) = (ratio(&read), ratio(&flooded));
    print(
        "p99 lateness of the tick at 1 kHz",
        &[
            Measure::new("alone", "µs", alone.clone()),
            Measure::new("4 readers of the joint state at 1 kHz", "µs", read),
            Measure::new("10 000 requests/s", "µs", flooded),
            Measure::new("4 readers, relative to none", "×", read_ratio).goal(Goal::AtMost(1.1)),
            Measure::new("10 000 requests/s, relative to none", "×", flood_ratio).goal(Goal::AtMost(1.1)),
        ],
    );
    Ok(())
}

type Load = Box<dyn FnOnce(Client) + Send>;

/// Returns the p99 lateness of a separate run under a load [µs].
fn lateness(time: Duration, loads: impl FnOnce(&Arc<AtomicBool>) -> Result<Vec<Load>, String>) -> Result<f64, String> {
    let mut run = fast_run()?;
    let stop = Arc::new(AtomicBool::new(false));
    let mut threads: Vec<JoinHandle<()>> = Vec::new();
    for load in loads(&stop)? {
        let client = run.client()?;
        threads.push(std::thread::spawn(move || load(client)));
    }
    std::thread::sleep(time);
    let status = run.client()?.call(Status {}).map_err(|e| e.to_string())?;
    stop.store(true, Ordering::Relaxed);
    for thread in threads {
        let _ = thread.join();
    }
    Ok(status.ticks.lateness_us.p99)
}

fn reader(stop: &Arc<AtomicBool>) -> Load {
    let stop = stop.clone();
    Box::new(move |mut client| {
        let stream = Subscribe::to(Stream::CoordinatorJointState);
        if client.call(stream).is_ok() {
            while !stop.load(Ordering::Relaxed) && client.next_message().is_ok() {}
        }
    })
}

fn flood(stop: &Arc<AtomicBool>) -> Load {
    let stop = stop.clone();
    Box::new(move |mut client| {
        let (began, mut sent) = (Instant::now(), 0u64);
        while !stop.load(Ordering::Relaxed) {
            if client.call(State {}).is_err() {
                return;
            }
            sent += 1;
            let due = began + Duration::from_secs_f64(sent as f64 / FLOOD);
            std::thread::sleep(due.saturating_duration_since(Instant::now()));
        }
        println!("  ({:.0} requests/s)", sent as f64 / began.elapsed().as_secs_f64());
    })
}

const SERVO: &str = "\
include: [coordinator-mock]
tasks:
  - {name: servo_arm, type: servo, joint_names: {hardware: arm}, priority: 20}
";

/// Measures a policy loop in Python at 100 Hz by its own statistics.
fn python(effort: Effort) -> Result<(), String> {
    let folder = tempfile::tempdir().map_err(|e| e.to_string())?;
    let blueprint = folder.path().join("servo.yaml");
    std::fs::write(&blueprint, SERVO).map_err(|e| e.to_string())?;
    let mut run = LiveRun::start(&blueprint.display().to_string(), &[]).map_err(|e| e.to_string())?;
    run.client()?;
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/assets/python/example_policy.py");
    let seconds = effort.of("2", "60");
    let output = Command::new("python3")
        .args([script, "servo_arm", "--rate", "100", "--seconds", seconds])
        .env("DIMOS_WORLD", run.folder())
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .output()
        .map_err(|e| format!("python3: {e} (make test-tools)"))?;
    println!("servo from Python at 100 Hz for {seconds} s (goal: none missed)");
    println!("  {}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    Ok(())
}
