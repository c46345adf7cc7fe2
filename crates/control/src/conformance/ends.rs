//! Checks of everything that may end a task.

use super::bench::CONTESTED;
use super::{Bench, Check};
use crate::request::Request;
use crate::task_body::TargetKind;
use dimos_core::telemetry::{Outcome, TaskState};

pub const CHECKS: &[Check] = &[
    Check::new("comes_to_rest_on_cancel", "After a cancel the arm rests within 5 s, and the task has ended.", cancel),
    Check::new("comes_to_rest_without_targets", "When targets stop coming, the arm rests within 5 s.", timeout),
    Check::new("ends_when_the_arm_is_held", "A stop ends it at once; after a reset only a target moves it.", held),
    Check::new(
        "gives_way_to_a_stronger_task",
        "A joint that a stronger task took is claimed by targets only.",
        gives_way,
    ),
    Check::new("begins_again_after_its_end", "After a cancel it begins again with the next target.", again),
];

/// Longest time until the arm rests [s].
const LIMIT: f64 = 5.0;

fn at_rest(bench: &mut Bench, after: &str) -> Result<(), String> {
    bench.run(LIMIT);
    if let Some(fault) = bench.fault() {
        return Err(fault);
    }
    if bench.rests(1.0) { Ok(()) } else { Err(format!("the arm still moves {LIMIT} s after {after}")) }
}

fn cancel(bench: &mut Bench) -> Result<(), String> {
    bench.stream(1.0)?;
    if !bench.is_active() {
        return Err("it had ended before the cancel".to_owned());
    }
    match bench.cancel() {
        Some(Outcome::Cancelled) => {}
        outcome => return Err(format!("the cancel was answered with {outcome:?}")),
    }
    at_rest(bench, "a cancel")?;
    if bench.is_active() { Err(format!("it is {:?} after a cancel", bench.task()?.state)) } else { Ok(()) }
}

fn timeout(bench: &mut Bench) -> Result<(), String> {
    bench.stream(1.0)?;
    at_rest(bench, "the last target")?;
    let state = bench.task()?.state;
    if bench.usual()? == TargetKind::Trajectory && state != TaskState::Completed {
        return Err(format!("its motion is over, and it is {state:?}"));
    }
    Ok(())
}

fn held(bench: &mut Bench) -> Result<(), String> {
    bench.stream(1.0)?;
    bench.ask(Request::Stop { arm: None });
    let task = bench.task()?;
    if task.is_active() {
        return Err(format!("it is {:?} while the arm is held", task.state));
    }
    // It may decelerate along its path.
    bench.run(1.0);
    if !bench.task()?.claims.is_empty() {
        return Err("it claims joints of a held arm after 1 s".to_owned());
    }
    bench.enable()?;
    if bench.is_active() || !bench.rests(1.0) {
        return Err("it continued after the reset, without a target".to_owned());
    }
    bench.stream(0.5)?;
    if bench.is_active() { Ok(()) } else { Err("it takes no target after the reset".to_owned()) }
}

fn gives_way(bench: &mut Bench) -> Result<(), String> {
    bench.stream(0.5)?;
    bench.interfere(0.05);
    for _ in 0..5 {
        bench.tick(0);
        if bench.task()?.claims.iter().any(|claim| claim.joint == CONTESTED) {
            return Err("it took the joint back without a target".to_owned());
        }
    }
    bench.fault().map_or(Ok(()), Err)
}

fn again(bench: &mut Bench) -> Result<(), String> {
    bench.stream(0.5)?;
    bench.cancel();
    bench.run(LIMIT);
    let before = bench.positions();
    let target = match bench.usual()? {
        // The next in the stream may be far from where the task ended.
        TargetKind::Positions => {
            Request::Servo { task: 0, target: dimos_core::joint::joints_of(&before.map(|q| q + 0.05)) }
        }
        kind => bench.target(kind)?,
    };
    bench.lead(0.05);
    let outcome = bench.ask(target);
    if outcome != Some(Outcome::Accepted) || !bench.is_active() {
        return Err(format!("its next target: {outcome:?}"));
    }
    bench.run(0.2);
    if let Some(fault) = bench.fault() {
        return Err(fault);
    }
    if bench.positions() == before { Err("it did not move again".to_owned()) } else { Ok(()) }
}
