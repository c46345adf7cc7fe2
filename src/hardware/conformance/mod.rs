//! The conformance suite: what every adapter must do, checked against its emulator (or, where the adapter is its own
//! plant, against itself). A new row of the table is tested without a further line of code.
//!
//! Each check is a function in one of the lists below and starts with an adapter of its own that is not connected.

mod context;
mod device;
mod faults;
mod identity;
mod lifecycle;
mod motion;

pub use context::Context;

use std::panic::{AssertUnwindSafe, catch_unwind};

use crate::hardware::registry::AdapterSpec;

/// One thing that every adapter must do.
#[derive(Debug, Clone, Copy)]
pub struct Check {
    /// Its name, as in `stop_ends_motion`.
    pub name: &'static str,
    /// What it asks for, in a sentence.
    pub about: &'static str,
    /// Says what is wrong.
    pub run: fn(&mut Context) -> Result<(), String>,
}

/// What came out of a check.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// It does what it must.
    Passed,
    /// The check does not apply, and why.
    Skipped(String),
    /// What is wrong.
    Failed(String),
}

/// All checks, in the order in which they are best read.
pub fn checks() -> impl Iterator<Item = &'static Check> {
    [identity::CHECKS, lifecycle::CHECKS, device::CHECKS, motion::CHECKS, faults::CHECKS].into_iter().flatten()
}

/// Runs one check on one row. `allocations` counts the calling thread's allocations so far, where the program has a
/// counting allocator. A panic in the adapter is a failure.
pub fn run(row: &AdapterSpec, check: &Check, allocations: Option<fn() -> u64>) -> Outcome {
    let attempt = catch_unwind(AssertUnwindSafe(|| {
        let mut context = Context::new(row, allocations)?;
        let result = (check.run)(&mut context);
        context.adapter.disconnect();
        result.map(|()| context.skipped)
    }));
    match attempt {
        Ok(Ok(None)) => Outcome::Passed,
        Ok(Ok(Some(why))) => Outcome::Skipped(why),
        Ok(Err(why)) => Outcome::Failed(why),
        Err(panic) => {
            let text = panic.downcast_ref::<String>().map(String::as_str);
            let text = text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("without a message");
            Outcome::Failed(format!("panicked: {text}"))
        }
    }
}
