//! The conformance suite: what every adapter must do, checked against its emulator, or against the adapter alone if it
//! is its own plant. New rows of the table are tested without further code.
//!
//! Each check is a function in one of the lists below and starts with a new adapter that is not connected.

mod context;
mod device;
mod disconnects;
mod faults;
pub mod figures;
pub mod first_day;
pub mod first_motion;
mod gripper;
mod identity;
pub mod lag;
mod lifecycle;
mod lost;
mod motion;
mod parts;
pub mod peripheral;
mod setpoints;
mod speed;
mod stale;
mod stops;
mod streamed_state;
mod torque;

pub use context::{Context, Subject};

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use crate::registry::AdapterSpec;
use dimos_core::sync::{lock, panic_text};
use dimos_rt::host;

/// Effect of a check on the arm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Needs {
    /// Connects and reads. Nothing is enabled and nothing moves: safe for any arm.
    Nothing,
    /// Enables the motors and may move the arm fast: for emulators only.
    Motion,
    /// Cuts connections and plays faults: for emulators only.
    Faults,
}

/// A requirement on every adapter.
#[derive(Debug, Clone, Copy)]
pub struct Check {
    /// Its effect on the arm.
    pub needs: Needs,
    /// Its name, as in `stop_ends_motion`.
    pub name: &'static str,
    /// The requirement in one sentence.
    pub about: &'static str,
    /// Runs the check; the error says what is wrong.
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

/// Result of a check.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// The requirement is met.
    Passed,
    /// The check does not apply; why.
    Skipped(String),
    /// What is wrong.
    Failed(String),
}

/// Returns all checks, in reading order.
pub fn checks() -> impl Iterator<Item = &'static Check> {
    [
        identity::CHECKS,
        lifecycle::CHECKS,
        device::CHECKS,
        parts::CHECKS,
        gripper::CHECKS,
        streamed_state::CHECKS,
        motion::CHECKS,
        setpoints::CHECKS,
        speed::CHECKS,
        torque::CHECKS,
        stops::CHECKS,
        faults::CHECKS,
        stale::CHECKS,
        lost::CHECKS,
        disconnects::CHECKS,
    ]
    .into_iter()
    .flatten()
}

/// Runs one check on one row, against its emulator or its own plant. `allocations` returns the calling thread's
/// allocations so far, if the program has a counting allocator. A panic in the adapter is a failure.
pub fn run(row: &AdapterSpec, check: &Check, allocations: Option<fn() -> u64>) -> Outcome {
    run_on(&Subject { allocations, ..Subject::emulated(row) }, check).0
}

/// Runs one check on any subject; also returns its finding for the report. On a real device, checks that move it or
/// play faults are skipped.
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
        Err(panic) => (Outcome::Failed(format!("panicked: {}", panic_text(&*panic))), None),
    }
}

/// Maximum number of parallel checks of an emulated arm: they mostly wait for motion.
const MAX_PARALLEL: usize = 12;
/// The same for an arm whose controller is the clock: it wants an answer every millisecond, and ends a motion without
/// answers. Its checks run with the priority of a device thread.
const MAX_CLOCKED: usize = 2;

/// A check, its result, and its finding for the report.
pub type Made = (&'static Check, Outcome, Option<String>);

/// Runs checks on a subject until `interrupted` returns true. Calls `report` after each check, from any thread.
/// Results are in the order of the checks.
pub fn run_all(
    subject: &Subject,
    checks: &[&'static Check],
    report: &(dyn Fn(&Check, &Outcome) + Sync),
    interrupted: &(dyn Fn() -> bool + Sync),
) -> Vec<Made> {
    let next = AtomicUsize::new(0);
    let made = Mutex::new(Vec::new());
    // A real device has one connection: one check at a time.
    let clocked = subject.row.native_rate >= context::CLOCKED;
    let workers = match (subject.real, clocked) {
        (true, _) => 1,
        (false, true) => MAX_CLOCKED,
        (false, false) => MAX_PARALLEL,
    };
    std::thread::scope(|scope| {
        for _ in 0..workers {
            scope.spawn(|| {
                if clocked {
                    host::enter_realtime(host::DEVICE_PRIORITY);
                }
                loop {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    let Some(check) = checks.get(index).filter(|_| !interrupted()) else { return };
                    let (outcome, found) = run_on(subject, check);
                    report(check, &outcome);
                    lock(&made).push((index, (*check, outcome, found)));
                }
            });
        }
    });
    let mut made = made.into_inner().unwrap_or_else(|e| e.into_inner());
    made.sort_by_key(|(index, _)| *index);
    made.into_iter().map(|(_, made)| made).collect()
}
