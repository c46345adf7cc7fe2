//! Lateness of a run's tick, from its log, and an account of every period.

use std::path::Path;
use std::time::Duration;

use dimos::recording::messages::Tick;
use dimos::recording::replay::{LogReader, Payload, Selection};
use dimos::rpc::api::Status;

use crate::support::run::{LiveRun, keep_moving};
use crate::{Lateness, Periods};

/// Settling time before a measurement.
const SETTLE: Duration = Duration::from_secs(1);

/// Result of a run.
pub struct Ran {
    /// Lateness of its ticks.
    pub late: Lateness,
    /// Account of its periods.
    pub periods: Periods,
    /// Whether its tick ran under FIFO.
    pub fifo: bool,
}

/// Runs the shipped blueprint with its emulator, in motion, for this time.
pub fn run(period: Duration, time: Duration) -> Result<Ran, String> {
    let rate = format!("coordinator.tick_rate={}", 1.0 / period.as_secs_f64());
    let mut run = LiveRun::start("coordinator-yourarm", &["--set", &rate]).map_err(|e| e.to_string())?;
    let mut client = run.client()?;
    keep_moving(&mut client, (SETTLE + time).as_secs_f64() + 4.0)?;
    std::thread::sleep(SETTLE);
    let from = dimos::clock::wall_now();
    std::thread::sleep(time);
    let to = dimos::clock::wall_now();
    let status = client.call(Status {}).map_err(|e| e.to_string())?;
    let fifo = status.realtime.iter().any(|r| r.granted && r.what.contains("SCHED_FIFO"));
    let ticks = run.end(|log| ticks(log, from, to))??;
    let late = Lateness::of(ticks.iter().map(|t| t.late_ns as f64 * 1e-3).collect());
    Ok(Ran { late, periods: account(&ticks, period), fifo })
}

fn ticks(log: &Path, from: u64, to: u64) -> Result<Vec<Tick>, String> {
    let mut reader = LogReader::open(log).map_err(|e| e.to_string())?;
    let selection = Selection { topics: vec!["/dimos/tick".into()], from, to };
    reader.select(selection).map_err(|e| e.to_string())?;
    let mut ticks = Vec::new();
    while let Some(entry) = reader.next_entry().map_err(|e| e.to_string())? {
        if let Payload::Tick(tick) = entry.data {
            ticks.push(tick);
        }
    }
    Ok(ticks)
}

/// Counts periods with a tick in the log, periods reported as skipped, and the rest.
fn account(ticks: &[Tick], period: Duration) -> Periods {
    let mut periods = Periods { ticked: ticks.len().min(1), ..Periods::default() };
    for (before, tick) in ticks.iter().zip(ticks.iter().skip(1)) {
        let passed = (tick.deadline_ns - before.deadline_ns) as f64 / period.as_nanos() as f64;
        let skipped = tick.skipped as usize;
        periods.ticked += 1;
        periods.skipped += skipped;
        periods.unaccounted += (passed.round() as usize).abs_diff(skipped + 1);
    }
    periods
}
