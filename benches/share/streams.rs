//! Streams: what subscribers cost the tick, how old messages are, what the gateway takes for many arms.

use std::fmt::Write;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use dimos::rpc::api::Status;
use dimos::rpc::client::Client;
use dimos::rpc::server::streams::{Stream, Subscribe};

use crate::support::Effort;
use crate::support::measure::{Goal, Measure, print, quantile};
use crate::support::process;
use crate::{Shared, text};

/// Subscribers of every tick.
const SUBSCRIBERS: usize = 3;
/// Arms of a large cell.
const ARMS: usize = 32;

/// What a subscriber saw.
#[derive(Default)]
struct Seen {
    /// Ages of the messages [ms].
    ages: Vec<f64>,
    lost: u64,
}

/// Compares the lateness of the tick with and without subscribers, and measures the age of what they get.
pub fn tick(effort: Effort) -> Result<(), String> {
    let time = Duration::from_secs(effort.of(1, 10));
    let (mut alone, mut with, mut more) = (Vec::new(), Vec::new(), Vec::new());
    let (mut p50, mut p99, mut lost) = (Vec::new(), Vec::new(), Vec::new());
    for _ in 0..effort.of(1, 5) {
        let without = lateness(time, 0)?.0;
        let (late, seen) = lateness(time, SUBSCRIBERS)?;
        alone.push(without);
        with.push(late);
        more.push(late - without);
        let ages: Vec<f64> = seen.iter().flat_map(|s| s.ages.iter().copied()).collect();
        p50.push(quantile(&ages, 0.5));
        p99.push(quantile(&ages, 0.99));
        lost.push(seen.iter().map(|s| s.lost).sum::<u64>() as f64);
    }
    print(
        "tick at 1 kHz with a gateway and 3 subscribers of every tick, and without, in turns",
        &[
            Measure::new("p99 lateness, without gateway", "µs", alone),
            Measure::new("p99 lateness, with gateway and subscribers", "µs", with),
            Measure::new("difference", "µs", more).goal(Goal::AtMost(30.0)),
            Measure::new("age of the stream, p50", "ms", p50).goal(Goal::AtMost(0.25)),
            Measure::new("age of the stream, p99", "ms", p99).goal(Goal::AtMost(1.0)),
            Measure::new("messages lost", "", lost).goal(Goal::AtMost(0.0)),
        ],
    );
    Ok(())
}

/// Returns the p99 lateness of a run [µs], and what its subscribers saw.
fn lateness(time: Duration, subscribers: usize) -> Result<(f64, Vec<Seen>), String> {
    if subscribers == 0 {
        let set = ["--set", "coordinator.tick_rate=1000"];
        let mut run = crate::LiveRun::start("coordinator-mock", &set).map_err(text)?;
        run.client()?;
        std::thread::sleep(time);
        let status = run.client()?.call(Status {}).map_err(text)?;
        return Ok((status.ticks.lateness_us.p99, Vec::new()));
    }
    let mut shared = Shared::start("coordinator-mock", 1000)?;
    let seen = subscribe(&shared, subscribers, time)?;
    let status = shared.run.client()?.call(Status {}).map_err(text)?;
    Ok((status.ticks.lateness_us.p99, seen))
}

fn subscribe(shared: &Shared, count: usize, time: Duration) -> Result<Vec<Seen>, String> {
    let stop = Arc::new(AtomicBool::new(false));
    let mut reading: Vec<JoinHandle<Seen>> = Vec::new();
    for _ in 0..count {
        let (mut client, stop) = (shared.connect()?, stop.clone());
        client.call(Subscribe::to(Stream::CoordinatorJointState)).map_err(text)?;
        reading.push(std::thread::spawn(move || read(&mut client, &stop)));
    }
    std::thread::sleep(time);
    stop.store(true, Ordering::Relaxed);
    Ok(reading.into_iter().filter_map(|thread| thread.join().ok()).collect())
}

fn read(client: &mut Client, stop: &AtomicBool) -> Seen {
    let mut seen = Seen::default();
    while !stop.load(Ordering::Relaxed) {
        let Ok(message) = client.next_message() else { break };
        let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |time| time.as_secs_f64());
        if let Some(stamp) = message.data["stamp"].as_f64() {
            seen.ages.push((now - stamp) * 1e3);
        }
        seen.lost += message.lost;
    }
    seen
}

/// Measures the processor time of the gateway of many arms.
pub fn arms(effort: Effort) -> Result<(), String> {
    let (mut blueprint, folder) = ("hardware:\n".to_owned(), tempfile::tempdir().map_err(text)?);
    for arm in 0..ARMS {
        let joints = format!("joints: {{prefix: a{arm}, count: 6}}");
        let _ = writeln!(blueprint, "  - {{hardware_id: a{arm}, {joints}, adapter_type: mock}}");
    }
    let file = folder.path().join("arms.yaml");
    std::fs::write(&file, blueprint).map_err(text)?;
    let (mut share, mut lost) = (Vec::new(), Vec::new());
    for _ in 0..effort.of(1, 3) {
        let mut shared = Shared::start(&file.display().to_string(), 100)?;
        let gateway = shared.gateway()?;
        let used = || process::threads(gateway).values().sum::<u64>() as f64;
        let time = Duration::from_secs(effort.of(1, 10));
        let before = used();
        let seen = subscribe(&shared, 1, time)?;
        share.push(100.0 * (used() - before) / time.as_nanos() as f64);
        lost.push(seen.iter().map(|s| s.lost).sum::<u64>() as f64);
    }
    print(
        "32 arms at 100 Hz, one subscriber",
        &[
            Measure::new("processor time of the gateway", "% of a core", share).goal(Goal::AtMost(10.0)),
            Measure::new("messages lost", "", lost).goal(Goal::AtMost(0.0)),
        ],
    );
    Ok(())
}
