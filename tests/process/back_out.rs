//! `dimos back-out`: an arm retraces the logged way, with the real binary.

use std::time::Duration;

use crate::support::program::{Home, eventually};

/// Commanded positions of a log's ticks [rad].
fn commanded(log: &std::path::Path) -> Vec<Vec<f64>> {
    dimos::replay::motion::RecordedMotion::read(log, 0, u64::MAX).unwrap().rows
}

#[test]
fn an_arm_backs_out_the_way_it_came_and_not_through_obstacles() {
    let home = Home::new();
    let run = home.run("yourarm-planner");
    let distance = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    let (first, second) = ([0.3, -0.3, 0.6, 0.0, 0.8, 0.0], [0.3, 0.1, 0.3, 0.4, 0.8, 0.0]);
    let go = |to: &[f64]| to.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
    home.dimos("back-out").with(1).says(&["the log has no earlier motion of arm"]);
    home.dimos(&format!("move arm {}", go(&first))).with(0);
    home.dimos(&format!("move arm {}", go(&second))).with(0);
    let moving = home.start("move arm 0.9 -0.5 0.6 -0.4 0.8 0 --speed 0.3");
    eventually("it has left", || distance(&home.positions("arm"), &second) > 0.3);
    home.dimos("stop").with(0);
    moving.wait().with(1);
    // Held: the way is shown, and nothing moves.
    let held = home.positions("arm");
    home.dimos("back-out arm").with(1).shows(&["where it was at rest"]).says(&[
        "arm is held: stopped by an operator: dimos stop (pid ",
        "; nothing has moved",
        "hint: when it may move again: dimos arm reset arm, then dimos arm enable arm",
    ]);
    let shown = home.dimos("back-out --check --json").with(0).json();
    assert!(!shown["ready"].as_bool().unwrap() && shown["duration"].as_f64().unwrap() > 1.0, "{shown}");
    assert!(distance(&home.positions("arm"), &held) < 1e-3);
    home.dimos("arm reset arm").with(0);
    home.dimos("arm enable arm").with(0);
    // An obstacle in the way, where the arm was half-way before.
    let log = &home.logs()[0];
    let came = commanded(log);
    let halfway = came.iter().rev().find(|q| distance(q, &second) < 0.15).unwrap();
    home.dimos(&format!("plan arm {} --json", go(halfway))).with(0);
    let preview = home.dimos("preview --json").with(0).json();
    let at = preview["end_effectors"]["arm"].as_array().unwrap().last().unwrap().clone();
    home.dimos(&format!("world add crate --sphere 0.03 --at {} {} {}", at[0], at[1], at[2])).with(0);
    home.dimos("back-out").with(1).says(&["no plan: the path is blocked after ", "obstacle \"crate\""]);
    assert!(distance(&home.positions("arm"), &held) < 0.02, "nothing moved");
    home.dimos("world remove crate").with(0);

    let ticks = commanded(log).len();
    home.dimos("back-out").with(0).says(&["planned, collision-checked"]);
    assert!(distance(&home.positions("arm"), &second) < 4e-3, "{:?}", home.positions("arm"));
    // Again: not forwards to the stop, but on to the rest before.
    home.dimos("back-out").with(0);
    assert!(distance(&home.positions("arm"), &first) < 4e-3, "{:?}", home.positions("arm"));
    home.dimos("down").with(0);
    drop(run);
    let all = commanded(log);
    let off = |q: &Vec<f64>| came.iter().map(|p| distance(p, q)).fold(f64::INFINITY, f64::min);
    let farthest = all[ticks.min(all.len())..].iter().map(off).fold(0.0, f64::max);
    assert!(all.len() > ticks + 200 && farthest < 0.01, "{farthest} rad from the way it came");

    // Without a planner only with --direct; without a log not at all.
    let run = home.run("coordinator-yourarm");
    home.dimos("move arm 0.2 -0.3 0.6 0 0.8 0").with(0);
    let there = home.positions("arm");
    home.dimos("move arm 0.5 -0.1 0.4 0 0.8 0").with(0);
    home.dimos("back-out").with(1).says(&["this run has no planner", "add --direct"]);
    home.dimos("back-out --direct").with(0).says(&["direct, not collision-checked"]);
    assert!(distance(&home.positions("arm"), &there) < 4e-3);
    home.dimos("down").with(0);
    drop(run);
    let _run = home.run("coordinator-yourarm --no-record");
    home.dimos("back-out --direct").with(1).says(&["this run writes no log"]);
}

/// Measured positions of the arm in a log [rad].
fn measured(log: &std::path::Path) -> Vec<Vec<f64>> {
    let joints: Vec<String> = (1..=6).map(|k| format!("arm_joint{k}")).collect();
    dimos::replay::motion::RecordedMotion::measured(log, &joints, 0, u64::MAX).unwrap().rows
}

#[test]
fn a_long_and_curved_way_back_is_one_direct_motion() {
    let home = Home::new();
    let run = home.run("coordinator-yourarm");
    let distance = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    home.dimos("move arm 0.3 -0.2 0.5 0 0.4 0").with(0);
    let there = home.positions("arm");
    // A shorter rest is none.
    std::thread::sleep(Duration::from_millis(400));
    // The arm's own controller turns the wrist far, on a curve in the joints.
    home.dimos("move arm --native --pose 0.3 0 0.3").with(0);
    let came = measured(&home.logs()[0]);
    assert!(distance(&home.positions("arm"), &there) > 1.0, "{:?}", home.positions("arm"));
    home.dimos("back-out --direct").with(0).says(&["within ", " rad of the logged path", "not collision-checked"]);
    assert!(distance(&home.positions("arm"), &there) < 4e-3, "{:?}", home.positions("arm"));
    let back = measured(&home.logs()[0]);
    let off = |q: &Vec<f64>| came.iter().map(|p| distance(p, q)).fold(f64::INFINITY, f64::min);
    let farthest = back.iter().skip(came.len()).map(off).fold(0.0, f64::max);
    assert!(back.len() > came.len() + 100 && farthest < 0.03, "{farthest} rad from the way it came");
    // What moves the arm after a way back, without a task, is its last motion.
    home.dimos("move arm --native --pose 0.3 0 0.3").with(0);
    home.dimos("move arm --native --pose 0.25 0.1 0.3").with(0);
    let last = home.positions("arm");
    home.dimos("move arm --native --pose 0.3 0 0.3").with(0);
    let goal = home.dimos("back-out --direct --check --json").with(0).json()["goal"].clone();
    let goal: Vec<f64> = serde_json::from_value(goal).unwrap();
    assert!(distance(&goal, &last) < 4e-3, "{goal:?} instead of {last:?}");
    home.dimos("down").with(0);
    drop(run);
}
