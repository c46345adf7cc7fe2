//! Checks of the row itself, and of the targets that the task takes.

use serde_json::Value;

use super::{Bench, Check};
use crate::task_body::{Demand, TargetKind};
use crate::task_spec::TaskSetup;
use dimos_core::telemetry::{Outcome, TaskState};

pub const CHECKS: &[Check] = &[
    Check::new("row_is_complete", "The row has a name for blueprints, takes targets, and claims something.", complete),
    Check::new("unknown_parameters_are_refused", "A misspelt parameter is an error, not a default.", unknown_parameter),
    Check::new("rests_without_a_target", "Without a target it claims nothing.", rests),
    Check::new(
        "takes_its_targets_only",
        "It begins with each kind of target of its row and refuses the others.",
        takes,
    ),
    Check::new("refuses_what_is_not_finite", "A target with NaN or infinity is refused and moves nothing.", not_finite),
];

fn complete(bench: &mut Bench) -> Result<(), String> {
    let spec = bench.spec();
    let good = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
    match () {
        () if spec.name.is_empty() || !spec.name.chars().all(good) => {
            Err(format!("`{}` is no name for a type: use a to z, 0 to 9 and _", spec.name))
        }
        () if spec.takes.is_empty() => Err("it takes no target: nothing can begin it".to_owned()),
        () if spec.demand == Demand::Nothing => Err("its demand is nothing: it could move no joint".to_owned()),
        () if !(spec.params.default)().is_object() => Err("its parameters are no group of keys".to_owned()),
        () => Ok(()),
    }
}

fn unknown_parameter(bench: &mut Bench) -> Result<(), String> {
    let spec = *bench.spec();
    let mut params = (spec.params.default)();
    if let Some(group) = params.as_object_mut() {
        group.insert("no_such_parameter".to_owned(), Value::Bool(true));
    }
    let joints: Vec<u16> = (0..6).collect();
    let setup = TaskSetup { joints: &joints, params: &params, robot: Some(bench.robot()), leader: &[] };
    match (spec.build)(&setup) {
        Err(_) => Ok(()),
        Ok(_) => Err("it was built with a parameter that it does not have: deny_unknown_fields".to_owned()),
    }
}

fn rests(bench: &mut Bench) -> Result<(), String> {
    let rested = bench.rests(1.0);
    let task = bench.task()?;
    if !rested || task.state != TaskState::Idle || !task.claims.is_empty() {
        return Err(format!("it is {:?} and claims {:?}", task.state, task.claims));
    }
    Ok(())
}

fn takes(bench: &mut Bench) -> Result<(), String> {
    for kind in TargetKind::ALL {
        let mut bench = bench.again()?;
        let target = bench.target(kind)?;
        let outcome = bench.ask(target);
        let takes = bench.spec().takes(kind);
        match (takes, outcome) {
            (true, Some(Outcome::Accepted)) if bench.is_active() => {}
            (false, Some(Outcome::WrongTask(_))) if !bench.is_active() => {}
            _ => {
                let state = bench.task()?.state;
                return Err(format!("{kind:?}: {outcome:?}, and then it is {state:?}; its row says takes: {takes}"));
            }
        }
    }
    Ok(())
}

fn not_finite(bench: &mut Bench) -> Result<(), String> {
    for kind in bench.spec().takes {
        let refused = |bench: &mut Bench| match Bench::not_finite(*kind).map(|target| bench.ask(target)) {
            None | Some(Some(Outcome::NonFinite(_) | Outcome::InvalidTarget(_))) => Ok(()),
            Some(outcome) => Err(format!("{kind:?}: {outcome:?}")),
        };
        let mut idle = bench.again()?;
        refused(&mut idle)?;
        if idle.is_active() || !idle.rests(0.5) {
            return Err(format!("{kind:?}: it began with it"));
        }
        let mut busy = bench.again()?;
        busy.stream(0.3)?;
        refused(&mut busy)?;
        busy.run(0.2);
        if let Some(fault) = busy.fault() {
            return Err(format!("{kind:?}: {fault}"));
        }
    }
    Ok(())
}
