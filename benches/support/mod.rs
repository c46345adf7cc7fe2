//! What both benchmarks share: the machine, statistics, tables, a live run of the real binary.

pub mod machine;
pub mod measure;
pub mod process;
pub mod run;

/// How much is measured: `--quick` on the command line or `DIMOS_BENCH_QUICK=1` makes it short.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Effort {
    /// Short: to see that it works, and for rough figures.
    pub quick: bool,
}

impl Effort {
    /// As this process was told.
    pub fn told() -> Self {
        let asked = std::env::args().any(|a| a == "--quick");
        Self { quick: asked || std::env::var_os("DIMOS_BENCH_QUICK").is_some_and(|v| v == "1") }
    }

    /// One of two numbers.
    pub fn of<T>(self, quick: T, full: T) -> T {
        if self.quick { quick } else { full }
    }
}
