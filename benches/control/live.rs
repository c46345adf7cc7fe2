//! Resources of a run: start-up time, memory, processor time; measured on the real binary.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::{Duration, Instant};

use dimos::recording::replay::{LogReader, Payload, Selection};

use crate::support::process::{self, Memory};
use crate::support::run::{LiveRun, keep_moving};

/// Maximum settling time before a measurement.
const SETTLE: Duration = Duration::from_secs(2);

/// Time from the start of the process to its first joint state [ms].
pub struct StartUp {
    /// Until the tick received it.
    pub known: f64,
    /// Until it was readable in the log file.
    pub readable: f64,
}

/// Starts a run and watches its log.
pub fn start_up(blueprint: &str) -> Result<StartUp, String> {
    let wall = dimos::clock::wall_now();
    let mut run = LiveRun::start(blueprint, &[]).map_err(|e| e.to_string())?;
    let log = run.log();
    let mut length = 0;
    let first = loop {
        if run.started.elapsed() > Duration::from_secs(5) {
            return Err("no joint state within 5 s".into());
        }
        std::thread::sleep(Duration::from_micros(500));
        let now = std::fs::metadata(&log).map_or(0, |m| m.len());
        if now != length {
            length = now;
            if let Some(first) = first_joint_state(&log) {
                break first;
            }
        }
    };
    let readable = run.started.elapsed().as_secs_f64() * 1e3;
    run.client()?;
    run.end(|_| ())?;
    Ok(StartUp { known: first.saturating_sub(wall) as f64 * 1e-6, readable })
}

/// Returns the Unix time of the first joint state in a log that is still being written [ns].
fn first_joint_state(log: &Path) -> Option<u64> {
    let mut reader = LogReader::open(log).ok()?;
    reader.select(Selection { topics: vec!["/joint_states".into()], ..Selection::default() }).ok()?;
    reader.next_entry().ok()?.map(|e| e.log_time)
}

/// Resources of a run in motion.
pub struct Cost {
    /// Memory.
    pub memory: Memory,
    /// Processor time of each thread, in per cent of one core.
    pub threads: BTreeMap<String, f64>,
    /// Compute times of its ticks during the measurement [µs].
    pub compute: Vec<f64>,
}

impl Cost {
    /// Returns the processor time of all threads together.
    pub fn total(&self) -> f64 {
        self.threads.values().sum()
    }
}

/// Measures a run in motion for this time.
pub fn cost(blueprint: &str, arguments: &[&str], time: Duration) -> Result<Cost, String> {
    let mut run = LiveRun::start(blueprint, arguments).map_err(|e| e.to_string())?;
    let mut client = run.client()?;
    let settle = SETTLE.min(time / 2);
    keep_moving(&mut client, (settle + time).as_secs_f64() + 4.0)?;
    std::thread::sleep(settle);
    let (before, began, from) = (process::threads(run.pid()), Instant::now(), dimos::clock::wall_now());
    std::thread::sleep(time);
    let (after, took, to) = (process::threads(run.pid()), began.elapsed(), dimos::clock::wall_now());
    let memory = process::memory(run.pid());
    let used = |(name, ns): (String, u64)| {
        let ns = ns.saturating_sub(before.get(&name).copied().unwrap_or_default());
        (name, 100.0 * ns as f64 / took.as_nanos() as f64)
    };
    let compute = run.end(|log| compute_times(log, from, to))??;
    Ok(Cost { memory, threads: after.into_iter().map(used).collect(), compute })
}

fn compute_times(log: &Path, from: u64, to: u64) -> Result<Vec<f64>, String> {
    let mut reader = LogReader::open(log).map_err(|e| e.to_string())?;
    let selection = Selection { topics: vec!["/dimos/tick".into()], from, to };
    reader.select(selection).map_err(|e| e.to_string())?;
    let mut times = Vec::new();
    while let Some(entry) = reader.next_entry().map_err(|e| e.to_string())? {
        if let Payload::Tick(tick) = entry.data {
            times.push(tick.compute_ns as f64 * 1e-3);
        }
    }
    Ok(times)
}
