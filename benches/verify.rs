//! `dimos replay --verify`: ticks per second, on a log of ten minutes at 100 Hz (`--quick`: of 20 s).

#[path = "../tests/support/virtual_run.rs"]
#[allow(dead_code, reason = "shared with tests")]
mod virtual_run;

#[path = "support/mod.rs"]
#[allow(dead_code, reason = "shared with the other benchmarks")]
mod support;

use std::process::ExitCode;
use std::time::Instant;

use dimos::control::point_to_point::point_to_point;
use dimos::control::request::Request;
use dimos::control::task_spec::TaskTable;
use dimos::joint::{JointLimits, make_joints};
use dimos::replay::verify::{Finding, verify};
use dimos::telemetry::TaskState;
use support::measure::{Goal, Measure};
use virtual_run::{VirtualRun, one_arm};

const GOAL: f64 = 200_000.0;

fn main() -> ExitCode {
    let effort = support::Effort::from_environment();
    support::machine::print();
    let folder = tempfile::tempdir().expect("a temporary folder can be made");
    let ticks = effort.of(2_000, 60_000);
    let mut measures = Vec::new();
    for dof in [6, 7] {
        let log = folder.path().join(format!("{dof}.mcap"));
        record(dof, ticks, &log);
        let size = std::fs::metadata(&log).map_or(0, |m| m.len()) as f64 / 1e6;
        let rates = (0..5).map(|_| ticks_per_second(&log)).collect();
        let what = format!("{dof} joints, {ticks} ticks, {size:.1} MB");
        measures.push(Measure::new(what, "ticks/s", rates).goal(Goal::AtLeast(GOAL)));
    }
    support::measure::print("dimos log verify", &measures);
    effort.end()
}

fn ticks_per_second(log: &std::path::Path) -> f64 {
    let began = Instant::now();
    let found = verify(log, &TaskTable::builtin()).expect("the log can be read");
    assert_eq!(found.finding, Finding::Reproducible);
    found.ticks as f64 / began.elapsed().as_secs_f64()
}

/// Records an arm that moves back and forth.
fn record(dof: usize, ticks: u64, log: &std::path::Path) {
    let mut run = VirtualRun::start(&one_arm(dof), log);
    let limits = JointLimits::uniform(dof, 3.0, 2.0).with_defaults();
    let names = make_joints("arm", dof);
    let (mut from, mut to) = (vec![0.0; dof], vec![0.7; dof]);
    run.step();
    run.ask(Request::Enabled { arm: 0, outside: false });
    while run.tick < ticks {
        if run.tick > 100 && run.tasks[0].state != TaskState::Executing {
            let motion = point_to_point(&names, &from, &to, &limits, 0.7).expect("a valid motion");
            run.execute(0, &motion);
            std::mem::swap(&mut from, &mut to);
        }
        run.step();
    }
    run.finish();
}
