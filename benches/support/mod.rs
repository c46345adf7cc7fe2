//! Shared by the benchmarks: the machine, statistics, tables, a live run of the real binary.

pub mod figures;
pub mod machine;
pub mod measure;
pub mod process;
pub mod run;

use std::process::ExitCode;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Number of parts that could not be measured.
static MISSING: AtomicUsize = AtomicUsize::new(0);
/// Number of figures without a value.
static EMPTY: AtomicUsize = AtomicUsize::new(0);

/// Reports a figure without a value: nothing was measured, or no number. It fails the benchmark.
pub fn empty(what: &str) {
    println!("FAILED: {what} has no value");
    EMPTY.fetch_add(1, Ordering::Relaxed);
}

/// Reports a part that could not be measured, and why; not for tools that are not installed.
pub fn skipped(what: &str) {
    println!("SKIPPED: {what}\n");
    MISSING.fetch_add(1, Ordering::Relaxed);
}

/// Extent of the measurements: `--quick` on the command line or `DIMOS_BENCH_QUICK=1` reduces them to seconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Effort {
    /// Short: to see that every part works; its figures mean little.
    pub quick: bool,
}

impl Effort {
    /// Reads it from the command line and the environment.
    pub fn from_environment() -> Self {
        let asked = std::env::args().any(|a| a == "--quick");
        Self { quick: asked || std::env::var_os("DIMOS_BENCH_QUICK").is_some_and(|v| v == "1") }
    }

    /// Returns the exit code: a missed goal fails no benchmark, but a figure without a value does, and in the short
    /// form a part that did not run. Writes the figures of the long form where `DIMOS_FIGURES` says.
    pub fn end(self) -> ExitCode {
        let missing = self.quick && MISSING.load(Ordering::Relaxed) > 0;
        let written = self.quick || figures::write();
        match missing || EMPTY.load(Ordering::Relaxed) > 0 || !written {
            true => ExitCode::FAILURE,
            false => ExitCode::SUCCESS,
        }
    }

    /// Selects one of two values.
    pub fn of<T>(self, quick: T, full: T) -> T {
        if self.quick { quick } else { full }
    }
}
