//! What the benchmarks share: the machine, statistics, tables, a live run of the real binary.

pub mod machine;
pub mod measure;
pub mod process;
pub mod run;

use std::process::ExitCode;
use std::sync::atomic::{AtomicUsize, Ordering};

/// How many parts could not be measured.
static MISSING: AtomicUsize = AtomicUsize::new(0);

/// Tells that a part could not be measured, and why; a tool that is not installed is no such reason.
pub fn skipped(what: &str) {
    println!("SKIPPED: {what}\n");
    MISSING.fetch_add(1, Ordering::Relaxed);
}

/// How much is measured: `--quick` on the command line or `DIMOS_BENCH_QUICK=1` makes it seconds long.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Effort {
    /// Short: to see that every part works. Its figures say little.
    pub quick: bool,
}

impl Effort {
    /// As this process was told.
    pub fn told() -> Self {
        let asked = std::env::args().any(|a| a == "--quick");
        Self { quick: asked || std::env::var_os("DIMOS_BENCH_QUICK").is_some_and(|v| v == "1") }
    }

    /// How the benchmark ends: figures fail nothing, but the short form is there to see that every part runs.
    pub fn end(self) -> ExitCode {
        match self.quick && MISSING.load(Ordering::Relaxed) > 0 {
            true => ExitCode::FAILURE,
            false => ExitCode::SUCCESS,
        }
    }

    /// One of two numbers.
    pub fn of<T>(self, quick: T, full: T) -> T {
        if self.quick { quick } else { full }
    }
}
