//! `make jitter`: wake-up lateness of the tick compared with `cyclictest`. Prints and judges figures; no figure fails
//! it.

mod cyclictest;
mod device_clock;
mod ours;
#[path = "../support/mod.rs"]
#[allow(dead_code, reason = "shared with the other benchmark")]
mod support;

use std::process::ExitCode;
use std::time::Duration;

use dimos::rt::host::TICK_PRIORITY;
use support::measure::{figure, print_rows, quantile, verdict};
use support::{Effort, machine};

/// Minimum allowance on top of cyclictest's p99; its own spread applies if larger [µs].
const ALLOWANCE: f64 = 20.0;

/// Wake-up lateness [µs].
#[derive(Debug, Clone, Copy)]
pub struct Lateness {
    p50: f64,
    p99: f64,
    p99_9: f64,
    max: f64,
}

impl Lateness {
    /// Computes it from single wake-ups.
    pub fn of(late: Vec<f64>) -> Self {
        let at = |q| quantile(&late, q);
        Self { p50: at(0.5), p99: at(0.99), p99_9: at(0.999), max: at(1.0) }
    }

    /// Computes it from a histogram and the maximum.
    pub fn of_counts(counts: &[(f64, usize)], max: f64) -> Self {
        let all = counts.iter().flat_map(|&(late, n)| std::iter::repeat_n(late, n));
        Self { max, ..Self::of(all.collect()) }
    }

    fn columns(&self) -> [f64; 4] {
        [self.p50, self.p99, self.p99_9, self.max]
    }
}

/// Account of a run's periods.
#[derive(Debug, Clone, Copy, Default)]
pub struct Periods {
    /// Periods with a tick.
    pub ticked: usize,
    /// Periods reported as skipped, with the lateness that caused it.
    pub skipped: usize,
    /// Periods unaccounted for.
    pub unaccounted: usize,
}

fn main() -> ExitCode {
    let effort = Effort::from_environment();
    println!("\ndimos: lateness of the tick compared with cyclictest{}\n", effort.of(" (quick)", ""));
    machine::print();
    let yardstick = machine::cyclictest().is_some();
    if !yardstick {
        println!("SKIPPED: cyclictest (make test-tools): only the tick is measured\n");
    }
    println!(
        "Both: one SCHED_FIFO {TICK_PRIORITY} thread, absolute deadlines, memory locked, /dev/cpu_dma_latency at 0."
    );
    println!("Ours: coordinator-yourarm with its emulator, in motion, recorded. Lateness in µs.\n");
    // `-- --device-clock` measures the second part only.
    let rates: &[u32] = if std::env::args().any(|a| a == "--device-clock") { &[] } else { &[100, 250, 1000] };
    for &rate in rates {
        if let Err(e) = compare(rate, effort, yardstick) {
            support::skipped(&format!("{rate} Hz: {e}"));
        }
    }
    println!("From a state of an emulated Franka controller to the command that answers it, in µs.\n");
    if let Err(e) = device_clock::compare(effort) {
        support::skipped(&format!("device clock: {e}"));
    }
    effort.end()
}

/// Measures interleaved pairs at one rate.
fn compare(rate: u32, effort: Effort, yardstick: bool) -> Result<(), String> {
    let (period, time) = (Duration::from_secs(1) / rate, Duration::from_secs(effort.of(1, 10)));
    let before = machine::CpuTimes::now();
    let (mut theirs, mut ours, mut periods, mut fifo) = (Vec::new(), Vec::new(), Periods::default(), true);
    let pairs = effort.of(1, 5);
    for _ in 0..pairs + effort.of(2, 0) {
        if ours.len() == pairs {
            break;
        }
        let yardstick = yardstick.then(|| cyclictest::run(period, time, TICK_PRIORITY)).transpose()?;
        // An overloaded machine also delays the emulator, and then the arm is held.
        let ran = match ours::run(period, time) {
            Ok(ran) => ran,
            Err(e) => {
                println!("SKIPPED: a pair at {rate} Hz: {e}");
                continue;
            }
        };
        theirs.extend(yardstick);
        ours.push(ran.late);
        fifo &= ran.fifo;
        periods.ticked += ran.periods.ticked;
        periods.skipped += ran.periods.skipped;
        periods.unaccounted += ran.periods.unaccounted;
    }
    if ours.is_empty() {
        return Err("no run was measured".into());
    }
    let (busy, stolen) = machine::CpuTimes::since(before);
    let mut rows = vec![["", "p50", "p99", "p99.9", "max"].map(str::to_owned).to_vec()];
    for (i, late) in ours.iter().enumerate() {
        rows.extend(theirs.get(i).map(|t| row(format!("cyclictest {}", i + 1), &t.columns())));
        rows.push(row(format!("tick       {}", i + 1), &late.columns()));
    }
    let medians = |all: &[Lateness]| [0, 1, 2, 3].map(|c| quantile(&column(all, c), 0.5));
    if !theirs.is_empty() {
        rows.push(row("cyclictest, median".into(), &medians(&theirs)));
    }
    rows.push(row("tick, median".into(), &medians(&ours)));
    print_rows(&format!("{rate} Hz, {} pairs of {} s", ours.len(), time.as_secs()), rows);
    judge(&theirs, medians(&ours)[1], fifo);
    let Periods { ticked, skipped, unaccounted } = periods;
    println!(
        "  periods: {ticked} ticks + {skipped} reported as skipped, {unaccounted} unaccounted for: {}",
        verdict(unaccounted == 0)
    );
    println!("  during the measurement: {busy:.0} % of all cores busy, {stolen:.2} % stolen by the hypervisor\n");
    Ok(())
}

fn judge(theirs: &[Lateness], p99: f64, fifo: bool) {
    if !fifo {
        return println!("  SKIPPED: comparison: SCHED_FIFO is not granted (see docs/realtime.md)");
    }
    if theirs.is_empty() {
        return println!("  SKIPPED: comparison: cyclictest (make test-tools)");
    }
    let all = column(theirs, 1);
    let spread = quantile(&all, 1.0) - quantile(&all, 0.0);
    let most = quantile(&all, 0.5) + spread.max(ALLOWANCE);
    println!(
        "  p99 {} µs, goal ≤ {} µs (cyclictest's {} + max({ALLOWANCE:.0}, its spread {})): {}",
        figure(p99),
        figure(most),
        figure(quantile(&all, 0.5)),
        figure(spread),
        verdict(p99 <= most)
    );
}

fn column(all: &[Lateness], c: usize) -> Vec<f64> {
    all.iter().filter_map(|l| l.columns().get(c).copied()).collect()
}

fn row(name: String, values: &[f64]) -> Vec<String> {
    std::iter::once(name).chain(values.iter().map(|v| figure(*v))).collect()
}
