//! The conformance suite: what every adapter must do, checked against its emulator (or, where the adapter is its own
//! plant, against itself). A new row of the table is tested without a further line of code.
//!
//! Each check is a function in one of the lists below and starts with an adapter of its own that is not connected.

mod context;
mod device;
mod disconnects;
mod faults;
pub mod figures;
pub mod first_motion;
mod identity;
pub mod lag;
mod lifecycle;
mod motion;
mod stale;
mod stops;
mod streamed_state;

pub use context::{Context, Subject};

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use crate::hardware::registry::AdapterSpec;

/// What a check does to the arm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Needs {
    /// It connects and reads. Nothing is enabled and nothing moves: fit for any arm that is switched on.
    Nothing,
    /// It enables the motors and may move the arm, faster than one would with somebody beside it: for emulators.
    Motion,
    /// It cuts wires and lets faults happen: for emulators.
    Faults,
}

/// One thing that every adapter must do.
#[derive(Debug, Clone, Copy)]
pub struct Check {
    /// What it does to the arm.
    pub needs: Needs,
    /// Its name, as in `stop_ends_motion`.
    pub name: &'static str,
    /// What it asks for, in a sentence.
    pub about: &'static str,
    /// Says what is wrong.
    pub run: fn(&mut Context) -> Result<(), String>,
}

impl Check {
    const fn new(
        needs: Needs,
        name: &'static str,
        about: &'static str,
        run: fn(&mut Context) -> Result<(), String>,
    ) -> Self {
        Self { needs, name, about, run }
    }
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
    [
        identity::CHECKS,
        lifecycle::CHECKS,
        device::CHECKS,
        streamed_state::CHECKS,
        motion::CHECKS,
        stops::CHECKS,
        faults::CHECKS,
        stale::CHECKS,
        disconnects::CHECKS,
    ]
    .into_iter()
    .flatten()
}

/// Runs one check on one row, against its emulator or its own plant. `allocations` counts the calling thread's
/// allocations so far, where the program has a counting allocator. A panic in the adapter is a failure.
pub fn run(row: &AdapterSpec, check: &Check, allocations: Option<fn() -> u64>) -> Outcome {
    run_on(&Subject { allocations, ..Subject::emulated(row) }, check).0
}

/// Runs one check on any subject, with what it found worth telling. A check that may move a real device, or would do
/// it harm, is skipped.
pub fn run_on(subject: &Subject, check: &Check) -> (Outcome, Option<String>) {
    if subject.real && check.needs != Needs::Nothing {
        return (Outcome::Skipped("for the emulator only".to_owned()), None);
    }
    let attempt = catch_unwind(AssertUnwindSafe(|| {
        let mut context = Context::new(subject)?;
        let result = (check.run)(&mut context);
        context.adapter.disconnect();
        result.map(|()| (context.skipped, context.found))
    }));
    match attempt {
        Ok(Ok((None, found))) => (Outcome::Passed, found),
        Ok(Ok((Some(why), _))) => (Outcome::Skipped(why), None),
        Ok(Err(why)) => (Outcome::Failed(why), None),
        Err(panic) => {
            let text = panic.downcast_ref::<String>().map(String::as_str);
            let text = text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("without a message");
            (Outcome::Failed(format!("panicked: {text}")), None)
        }
    }
}

/// Checks of an emulated arm that run side by side: they mostly wait for motion.
const SIDE_BY_SIDE: usize = 12;

/// A check that was made, what came out of it, and what it found worth telling.
pub type Made = (&'static Check, Outcome, Option<String>);

/// Runs those checks on a subject, until `interrupted` says so; `tell` hears of each as it is done, from any thread.
/// The answer is in their order.
pub fn run_all(
    subject: &Subject,
    checks: &[&'static Check],
    tell: &(dyn Fn(&Check, &Outcome) + Sync),
    interrupted: &(dyn Fn() -> bool + Sync),
) -> Vec<Made> {
    let next = AtomicUsize::new(0);
    let made = Mutex::new(Vec::new());
    // A real device has one wire, and is asked one thing at a time.
    let workers = if subject.real { 1 } else { SIDE_BY_SIDE };
    std::thread::scope(|scope| {
        for _ in 0..workers {
            scope.spawn(|| {
                loop {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    let Some(check) = checks.get(index).filter(|_| !interrupted()) else { return };
                    let (outcome, found) = run_on(subject, check);
                    tell(check, &outcome);
                    made.lock().unwrap_or_else(|e| e.into_inner()).push((index, (*check, outcome, found)));
                }
            });
        }
    });
    let mut made = made.into_inner().unwrap_or_else(|e| e.into_inner());
    made.sort_by_key(|(index, _)| *index);
    made.into_iter().map(|(_, made)| made).collect()
}
