//! A run that pauses at full speed: no ticks, no setpoints, no states for some milliseconds, or messages that get lost.
//! In virtual time, for every row at every tick rate, against a model of each controller's reaction to silence. The
//! motion is a straight line of the joints, so whatever leaves the line, or goes back on it, is seen.
//! `DIMOS_PAUSE=123 cargo test --test logic pauses::one -- --nocapture` shows a case. `make pauses` runs many.

use std::collections::BTreeMap;

use dimos::control::request::Request;
use dimos::robot::random::Random;
use dimos::telemetry::{Cause, Phase, TaskState};

use crate::support::arm_rows::rows;
use crate::support::gap_arm::STEP;
use crate::support::pause_run::{Broken, Run};
use crate::support::rig::motion;

/// Pauses [ms]; 0 shows that the models alone break nothing.
const PAUSES: [u64; 9] = [0, 2, 5, 8, 12, 19, 25, 50, 90];
/// Shares of messages that are lost: setpoints, states.
const LOSSES: [(f64, f64); 4] = [(0.005, 0.0), (0.02, 0.0), (0.0, 0.005), (0.0, 0.02)];
/// What a case is about.
#[derive(Debug, Clone, Copy)]
enum Gap {
    /// Pause [s].
    Pause(f64),
    /// Shares of setpoints and states that are lost.
    Loss(f64, f64),
}

/// Rows at their rates, and what happens.
fn cases() -> Vec<(usize, f64, Gap)> {
    let gaps = || {
        let pauses = PAUSES.iter().map(|ms| Gap::Pause(*ms as f64 * 1e-3));
        pauses.chain(LOSSES.iter().map(|(setpoints, states)| Gap::Loss(*setpoints, *states)))
    };
    let rated = rows().iter().enumerate().flat_map(|(i, row)| row.rates().into_iter().map(move |rate| (i, rate)));
    rated.flat_map(|(i, rate)| gaps().map(move |gap| (i, rate, gap))).collect()
}

/// Plays a case of a seed. Returns the rules that it broke.
fn play(seed: u64, verbose: bool) -> (String, Broken) {
    let cases = cases();
    let (index, rate, gap) = cases[(seed % cases.len() as u64) as usize];
    let mut random = Random::new(seed);
    let mut run = Run::new(&rows()[index], rate, &mut random);
    run.verbose = verbose;
    let what = format!("{} at {rate} Hz, {gap:?}", run.row.name);
    (0..3).for_each(|_| run.tick(0, (false, false)));
    run.ask(Request::Enabled { arm: 0, outside: false });
    (0..(0.3 * rate) as u64).for_each(|_| run.tick(0, (false, false)));
    // As fast as the limits allow.
    let l = &run.row.arm.limits;
    let seconds = run.from.iter().zip(&run.to).enumerate().map(|(j, (a, b))| {
        let d = (b - a).abs();
        (1.9 * d / l.velocity_max[j]).max((5.9 * d / l.acceleration_max[j]).sqrt())
    });
    let seconds = seconds.fold(0.3, f64::max);
    let joints: Vec<u16> = (0..run.row.arm.dof as u16).collect();
    let motion = motion(1, &joints, &[(0.0, &run.from), (seconds, &run.to)]);
    let started = run.elapsed;
    run.ask(Request::Execute { task: 0, motion });
    let pause_at = started + (1e3 * seconds * random.between(0.05, 0.95)) as u64;
    let (lag, mut paused) = (run.row.arm.supervision.lag, false);
    let end = |rests: f64| started + (1e3 * (1.3 * seconds + 0.5 * rests + lag + 0.25)) as u64;
    while run.task.state == TaskState::Executing && run.elapsed < end(run.rests) {
        let lost = match gap {
            Gap::Loss(setpoints, states) => (random.unit() < setpoints, random.unit() < states),
            Gap::Pause(_) => (false, false),
        };
        let late = match gap {
            Gap::Pause(pause) if !paused && run.elapsed >= pause_at => {
                paused = true;
                // Setpoints lie on the grid of the ticks: a tick that is late within its period is no gap of its own.
                let between = run.period * ((pause / run.period + 1e-9).floor() + 1.0);
                let beyond = between > run.tolerance + 1e-9;
                run.rests += f64::from(u8::from(beyond));
                // What the controller does on its own, in this pause and, beyond its tolerance, until it rests.
                let mut own = run.arm.clone();
                let steps = ((run.period + pause) / STEP).round() as u64;
                (0..steps).for_each(|_| own.step());
                // How far a bridging that knows no plan runs ahead of the plan is not to be charged to the run.
                let plan = (run.elapsed - started) as f64 * 1e-3 + pause;
                let t = (plan / seconds).clamp(0.0, 1.0);
                let part = t * t * t * (10.0 - 15.0 * t + 6.0 * t * t);
                let whole = run.on_path(&run.to.clone()).0;
                let ahead = (run.on_path(&own.r).0 - part * whole).max(0.0);
                let mut off = run.on_path(&own.q).1.max(run.on_path(&own.r).1);
                for _ in 0..if beyond || own.error != 0 { 1500 } else { 0 } {
                    own.step();
                    off = off.max(run.on_path(&own.q).1);
                }
                run.own = (off, ahead);
                run.from_rest = beyond;
                (pause * 1e3).round() as u64
            }
            _ => 0,
        };
        run.tick(late, lost);
    }
    (0..(0.2 * rate) as u64).for_each(|_| run.tick(0, (false, false)));
    let (state, reason, phase) = (run.task.state, run.task.reason, run.phase);
    // A controller that ended the motion itself, a gap that the run reports, a run that lost 0.1 s.
    let lost_time = matches!(gap, Gap::Pause(pause) if pause + run.period > 0.1 - 1e-9);
    let honest = match phase.1 {
        Cause::Fault(_) => run.arm.error != 0,
        Cause::Overrun => lost_time,
        Cause::None => true,
        cause => run.rests > 0.0 && cause.name().contains("gap"),
    };
    if !honest {
        let error = run.arm.error;
        run.breaks("false cause", 1.0, || format!("{phase:?}, the controller's error is {error}"));
    }
    let reported = format!("{reason:?}").to_lowercase().contains("gap") && run.rests > 0.0;
    if state != TaskState::Completed && !(honest && phase.0 == Phase::Held) && !reported {
        let took = run.elapsed - started;
        run.breaks("not completed", 1.0, || format!("{state:?} {reason:?} after {took} ms, planned {seconds:.3} s"));
    }
    (what, run.broken)
}

/// Plays cases and prints what they broke: by row, and the first of each rule.
fn judge(seeds: impl Iterator<Item = u64>) {
    let (mut all, mut broken) = (0u64, 0u64);
    let mut by_row: BTreeMap<&str, (u64, u64)> = BTreeMap::new();
    let mut by_rule: BTreeMap<&str, (u64, f64, u64, String)> = BTreeMap::new();
    let cases = cases();
    for seed in seeds {
        let (what, found) = play(seed, false);
        let row = by_row.entry(rows()[cases[(seed % cases.len() as u64) as usize].0].name).or_default();
        *row = (row.0 + 1, row.1 + u64::from(!found.is_empty()));
        (all, broken) = (all + 1, broken + u64::from(!found.is_empty()));
        for (rule, (by, text)) in found {
            let worst = by_rule.entry(rule).or_insert((0, f64::NEG_INFINITY, 0, String::new()));
            worst.0 += 1;
            if by > worst.1 {
                (worst.1, worst.2, worst.3) = (by, seed, format!("{what}: {text}"));
            }
        }
    }
    by_row.iter().for_each(|(row, (all, broken))| println!("{row:10} {broken:6} of {all} cases"));
    for (rule, (count, by, seed, text)) in &by_rule {
        println!("{rule:18} {count:6} cases, worst {by:.4} (DIMOS_PAUSE={seed}): {text}");
    }
    assert_eq!(broken, 0, "of {all} cases broke a rule");
}

/// How often each case is played, and by which test of two.
fn part(odd: u64) {
    let times = std::env::var("DIMOS_PAUSES").ok().and_then(|n| n.parse().ok()).unwrap_or(2);
    judge((0..times * cases().len() as u64).filter(|seed| seed % 2 == odd));
}

#[test]
fn pauses_leave_arms_on_their_paths_part_1() {
    part(0);
}

#[test]
fn pauses_leave_arms_on_their_paths_part_2() {
    part(1);
}

/// Shows every tick of the case `DIMOS_PAUSE`.
#[test]
fn one() {
    let Ok(case) = std::env::var("DIMOS_PAUSE") else { return };
    let (what, found) = play(case.parse().expect("DIMOS_PAUSE is a number"), true);
    println!("{what}");
    assert!(found.is_empty(), "{found:#?}");
}
