//! The conformance suite for task types: what every row of the table must do, checked by a coordinator on a virtual
//! clock, with one simulated arm in memory. A new row is tested without a further line of code.
//!
//! Each check is a function in one of the lists below and starts with a task that has no target yet.

mod bench;
mod ends;
mod motion;
mod row;
mod tick;

pub use bench::Bench;

use std::panic::{AssertUnwindSafe, catch_unwind};

use super::task_spec::TaskSpec;
use dimos_core::sync::panic_text;

/// A rule for every task.
#[derive(Debug, Clone, Copy)]
pub struct Check {
    /// Its name, as in `comes_to_rest_on_cancel`.
    pub name: &'static str,
    /// The rule, in a sentence.
    pub about: &'static str,
    /// Runs the check. The error describes the violation.
    pub run: fn(&mut Bench) -> Result<(), String>,
}

impl Check {
    const fn new(name: &'static str, about: &'static str, run: fn(&mut Bench) -> Result<(), String>) -> Self {
        Self { name, about, run }
    }
}

/// Returns all checks, in reading order.
pub fn checks() -> impl Iterator<Item = &'static Check> {
    [row::CHECKS, motion::CHECKS, ends::CHECKS, tick::CHECKS].into_iter().flatten()
}

/// Runs one check on one row, with its default parameters. `allocations` counts the calling thread's allocations so
/// far, where the program has a counting allocator. A panic in the task is a failure.
pub fn run(row: &TaskSpec, check: &Check, allocations: Option<fn() -> u64>) -> Result<(), String> {
    let attempt = catch_unwind(AssertUnwindSafe(|| (check.run)(&mut Bench::new(row, allocations)?)));
    attempt.unwrap_or_else(|panic| Err(format!("panicked: {}", panic_text(&*panic))))
}
