//! `dimos do JOB.yaml`: runs a job from a file: motions, gripper, inputs and outputs, loops. docs/jobs.md has recipes.

mod execute;
mod file;
mod keys;
mod names;
mod on_path;
#[cfg(test)]
mod schema_tests;
mod step;
mod times;
mod until;
mod without_run;

use std::collections::BTreeSet;
use std::path::PathBuf;

use serde_json::json;

use super::arguments::Target;
use super::exit::{Exit, Failure, Result};
use super::follow::{Signals, held};
use super::output;
use crate::blueprint::Catalog;
use dimos_rpc::api::{Lease, World};
use execute::{End, Runner};
use names::Names;
use step::{Job, Step};
use times::Times;

/// Arguments of `do`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Every mistake of the file, and every name that the run does not have, is reported before anything moves.

  steps:
    - move: home                             a named or saved pose
    - move: {by: {xyz: [0, 0, -0.05]}, linear: true, speed: 20%}
    - gripper: {to: close, object: true}     a fault if it holds nothing then
    - wait: {input: di0, is: high, timeout: 5s}
    - repeat: {times: 3, steps: [{output: {do0: 1}}, {output: {do0: 0}}]}
  repeat: 10                                 or forever
  on_fault: [{gripper: open}, {move: home}]  default: stop

Ctrl-C, `dimos stop` and `dimos cancel` end the job; nothing moves afterwards, and no hold is cleared. Exit code 1 names \
the step.")]
pub struct Args {
    /// The job's file; builtin:demo is that of `dimos demo`
    #[arg(value_name = "JOB.yaml")]
    pub job: PathBuf,
    /// Check the file, and its names if a run is live; move nothing
    #[arg(long)]
    pub check: bool,
    /// Check it against this blueprint, without a run: arms, joints and their limits
    #[arg(long, value_name = "BLUEPRINT", requires = "check", conflicts_with = "run")]
    pub blueprint: Option<String>,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args, catalog: Catalog<'_>) -> Result {
    let mut job = Job::read(&args.job)?;
    if args.check {
        return check(args, &mut job, catalog);
    }
    // A mistake in the file is reported without a run, too; with one, together with names that it does not know.
    let mut client = args.target_run.connect().or_else(|failure| job.verdict().and(Err(failure)))?;
    let signals = Signals::watch();
    let names = Names::of(&mut client)?;
    names.check(&mut job)?;
    for arm in arms(&job) {
        client.call(Lease { arm: Some(arm) })?;
    }
    let quiet = args.target_run.json;
    let (times, ready) = (vec![Times::default(); job.count], BTreeSet::new());
    let mut runner = Runner {
        client: &mut client,
        signals: &signals,
        job: &job,
        names: &names,
        times,
        cycles: Times::default(),
        quiet,
        arms: arms(&job),
        ready,
        epoch: 0,
    };
    let ended = runner.run();
    let mut after = None;
    let mut late_signal = None;
    if let Err((_, End::Fault(_))) = &ended {
        let result = runner.on_fault();
        late_signal = result.as_ref().err().and_then(|(_, signal)| *signal);
        after = Some(result.unwrap_or_else(|(what, _)| what));
    }
    let (times, cycles) = (runner.times, runner.cycles);
    let mut report = times::to_json(&job, &times, &cycles);
    let (ended, result) = match ended {
        Ok(()) => ("done", Ok(Exit::Ok)),
        Err((step, End::Signal(signal))) => {
            output::note(format_args!("interrupted at {}", place(&job, step, &cycles)));
            ("interrupted", Ok(Exit::by_signal(signal)))
        }
        Err((step, End::Stopped(failure))) => ("stopped", Err((step, failure))),
        Err((step, End::Fault(failure))) => ("fault", Err((step, failure))),
    };
    let objects = client.call(World {}).map(|world| world.objects).unwrap_or_default();
    let held_objects =
        objects.into_iter().filter_map(|object| Some((object.held_by?.into_iter().next()?, object.name)));
    let held_objects: Vec<_> = held_objects.filter(|_| result.is_err()).collect();
    if quiet {
        report["job"] = json!(job.file);
        report["ended"] = json!(ended);
        report["on_fault"] = json!(after);
        if let Err((step, failure)) = &result {
            report["step"] = json!({"line": step.line, "step": step.text, "error": failure.what});
        }
        report["held"] = json!(held_objects);
        output::json(&report);
    } else {
        times::print(&job, &times, &cycles);
        if let Some(after) = after.filter(|_| !job.on_fault.is_empty()) {
            output::note(format_args!("on_fault: {after}"));
        }
        held_objects.iter().for_each(|(arm, object)| output::note(format_args!("{arm} holds {object}")));
    }
    if let Some(signal) = late_signal {
        return Ok(Exit::by_signal(signal));
    }
    result.map_err(|(step, failure)| {
        let what = format!("{}: {}", place(&job, step, &cycles), failure.what);
        let hint = held(&mut client).or_else(|| failure.hint.clone());
        Failure { what, hint, exit: Exit::Failed, ..failure }
    })
}

/// Checks a job without running it.
fn check(args: &Args, job: &mut Job, catalog: Catalog<'_>) -> Result {
    if let Some(blueprint) = &args.blueprint {
        Names::of_blueprint(blueprint, catalog)?.check(job)?;
        output::note("saved poses, objects, grippers, inputs and outputs are a run's: they were not checked");
    } else if let Some(mut client) = args.target_run.connect_if_live()? {
        Names::of(&mut client)?.check(job)?;
    } else {
        without_run::doubt_positions(job);
        job.verdict()?;
        output::note("no run is live: the names of arms, poses, inputs and objects were not checked");
    }
    let count = |steps: &[Step]| {
        let mut all = Vec::new();
        times::all(steps, &mut all);
        all.len()
    };
    let (steps, on_fault) = (count(&job.steps), count(&job.on_fault));
    match args.target_run.json {
        true => output::json(&json!({"ok": true, "steps": steps, "on_fault": on_fault})),
        false => {
            let more = if on_fault > 0 { format!(" and {on_fault} on a fault") } else { String::new() };
            output::line(format_args!("{}: {steps} steps{more}, no mistakes", job.file));
        }
    }
    Ok(Exit::Ok)
}

/// Returns the arms that a job commands.
fn arms(job: &Job) -> BTreeSet<String> {
    let mut steps = Vec::new();
    times::all(&job.steps, &mut steps);
    times::all(&job.on_fault, &mut steps);
    steps.into_iter().map(|step| step.arm.clone()).filter(|arm| !arm.is_empty()).collect()
}

/// Names a step and the cycle in which it ended: `pick.yaml:9: move: home, in cycle 3`.
fn place(job: &Job, step: &Step, cycles: &Times) -> String {
    format!("{}:{}: {}, in cycle {}", job.file, step.line, step.text, cycles.count() + 1)
}
