//! A day of a run in virtual time: ticks, requests and the recorder take no more memory, no file descriptor and no
//! thread at its end than after ten minutes, and its log comes out the same again. `make soak` plays 24 hours,
//! `DIMOS_DAY=3` three.

use std::path::Path;

use dimos::control::config::{ServoParams, TaskConfig, TaskKind, VelocityParams};
use dimos::control::point_to_point::point_to_point;
use dimos::control::request::Request;
use dimos::control::task_spec::TaskTable;
use dimos::joint::{JointLimits, joints_of, make_joints};
use dimos::recording::storage::Storage;
use dimos::robot::random::Random;

use crate::support::usage::Usage;
use crate::support::virtual_run::{PERIOD, VirtualRun, one_arm};
use crate::verify::reproducible;

/// Without `DIMOS_DAY` [h].
const HOURS: f64 = 0.5;
/// A run is what it stays after this time [s], and at most a third of it all.
const SETTLED: f64 = 600.0;
/// Growth that is none [bytes].
const FLAT: u64 = 1 << 20;

/// Asks something, and lets some time pass.
fn ask(run: &mut VirtualRun, random: &mut Random) {
    let here = run.states[0].position[..6].to_vec();
    let near = |random: &mut Random| joints_of(&[(); 6].map(|()| random.between(-0.5, 0.5)));
    match random.below(9) {
        0..=3 => {
            let limits = JointLimits::uniform(6, 3.0, 2.0).with_defaults();
            let goal: Vec<f64> = (0..6).map(|_| random.between(-1.5, 1.5)).collect();
            let speed = random.between(0.2, 1.0);
            if let Ok(motion) = point_to_point(&make_joints("arm", 6), &here, &goal, &limits, speed) {
                run.execute(0, &motion);
            }
        }
        4 => {
            for _ in 0..50 {
                let step = near(random).map(|q| 0.01 * q);
                let target = std::array::from_fn(|j| run.states[0].position[j] + step[j]);
                run.ask(Request::Servo { task: 1, target });
                run.step();
            }
        }
        5 => run.ask(Request::Velocity { task: 2, target: near(random) }),
        6 => run.ask(Request::Cancel { task: None }),
        7 => run.ask(Request::Speed { fraction: random.between(0.1, 1.0) }),
        _ => {
            run.ask(Request::Stop { arm: None });
            (0..100).for_each(|_| run.step());
            run.ask(Request::Reset { arm: 0 });
            run.step();
            run.ask(Request::Enabled { arm: 0, outside: false });
        }
    }
    (0..random.below(400)).for_each(|_| run.step());
    run.recorded();
}

/// A run of a log in files of an hour.
fn play(folder: &Path, hours: f64) -> (Usage, Usage) {
    let mut config = one_arm(6);
    let task = |name: &str, kind, priority| TaskConfig {
        name: name.into(),
        kind,
        joints: (0..6).collect(),
        priority,
        auto_start: false,
    };
    config.tasks.push(task("servo", TaskKind::new("servo", &ServoParams::default()), 20));
    config.tasks.push(task("velocity", TaskKind::new("velocity", &VelocityParams::default()), 30));
    let log = folder.join("day.mcap");
    let mut run = VirtualRun::start_stored(&TaskTable::builtin(), &config, Some(&log), Storage::default());
    let mut random = Random::new(1);
    run.step();
    run.ask(Request::Enabled { arm: 0, outside: false });
    let ticks = |seconds: f64| (seconds / PERIOD.as_secs_f64()) as u64;
    let (settled, end) = (ticks(SETTLED.min(1200.0 * hours)), ticks(3600.0 * hours));
    let mut first = None;
    while run.tick < end {
        ask(&mut run, &mut random);
        if run.tick >= settled && first.is_none() {
            first = Some(Usage::of_this_process());
        }
    }
    let last = Usage::of_this_process();
    run.finish();
    (first.expect("it has settled"), last)
}

#[test]
fn a_day_takes_no_more_than_ten_minutes() {
    let hours = std::env::var("DIMOS_DAY").ok().and_then(|hours| hours.parse().ok()).unwrap_or(HOURS);
    let folder = tempfile::tempdir().unwrap();
    let (first, last) = play(folder.path(), hours);
    println!("{hours} h: {first:?}, then {last:?}");
    assert!(last.memory <= first.memory + FLAT, "{first:?} {last:?}");
    assert_eq!((last.files, last.threads), (first.files, first.threads));
    let verified = reproducible(&folder.path().join("day.mcap"));
    println!("{} ticks are the same again", verified.ticks);
}
