//! Arms that report what is not so, on the wire of every protocol: what no true joint, no setpoint and no stop may do.
//! `make lies-wire` plays 1,000 for each; `DIMOS_WIRE_LIES=50` this many. `DIMOS_WIRE_ARM=xarm` plays only those of
//! that arm, `DIMOS_WIRE_LIE=123` only that one, `DIMOS_WIRE_FROM=500` those from there on.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Instant;

use crate::serial;
use crate::support::wire;
use crate::support::wire::arms::{Arm, FRANKA, PIPER, REMOTE, SO101, UR, XARM, YOURARM};
use crate::support::wire::lying::trial;
use crate::support::wire::watch::Watch;

/// Of each arm.
const TRIALS: u64 = 30;
/// Trials that once found something: the stop of an arm that answered with false readings was taken for that of a
/// silent one; a reading that slipped was taken for a joint behind the seam of its encoder; one nowhere near what an
/// arm may have followed in silence was taken for where it is.
const KEPT: [(&str, u64); 4] = [("so101", 58), ("so101", 99), ("piper", 426), ("piper", 471)];
/// Repetitions of a case in which this computer was stalled for longer than [`SPOILT`] [s].
const REPETITIONS: usize = 4;
const SPOILT: f64 = 0.02;

fn number(variable: &str) -> Option<u64> {
    std::env::var(variable).ok().and_then(|n| n.parse().ok())
}

/// Plays trials of an arm. Returns what they broke.
fn play(arm: Arm, seeds: impl Iterator<Item = u64>) -> Vec<String> {
    let watch = Watch::of_programs();
    let mut broken = Vec::new();
    for seed in seeds {
        if seed > 0 && seed.is_multiple_of(100) {
            println!("{} {seed}", arm.name);
        }
        let (mut what, mut found) = (String::new(), Vec::new());
        for _ in 0..REPETITIONS {
            let began = Instant::now();
            (what, found) = catch_unwind(AssertUnwindSafe(|| trial(arm, seed))).unwrap_or_else(|panic| {
                let text = panic.downcast_ref::<String>().cloned();
                (String::new(), vec![text.unwrap_or_else(|| "panicked".to_owned())])
            });
            if found.is_empty() || watch.longest_since(began).as_secs_f64() < SPOILT {
                break;
            }
        }
        if !found.is_empty() || number("DIMOS_WIRE_LIE").is_some() {
            println!("{} {seed} {what}: {found:#?}", arm.name);
        }
        broken.extend(found.into_iter().map(|f| format!("{} {seed} ({what}): {f}", arm.name)));
    }
    broken
}

#[test]
fn lies_on_the_wire_move_no_arm() {
    let all = [YOURARM, XARM, PIPER, REMOTE, UR, FRANKA, SO101, wire::arms::serial(&serial::SPEC)];
    let only = std::env::var("DIMOS_WIRE_ARM").ok();
    let arms: Vec<Arm> = all.into_iter().filter(|arm| only.as_ref().is_none_or(|only| only == arm.name)).collect();
    let trials = number("DIMOS_WIRE_LIES").unwrap_or(TRIALS);
    let (one, from) = (number("DIMOS_WIRE_LIE"), number("DIMOS_WIRE_FROM").unwrap_or(0));
    let seeds = |arm: Arm| -> Vec<u64> {
        let kept = KEPT.iter().filter(|(name, seed)| *name == arm.name && *seed >= trials).map(|(_, seed)| *seed);
        one.map_or_else(|| (from..trials).chain(kept).collect(), |seed| vec![seed])
    };
    let broken: Vec<String> = std::thread::scope(|scope| {
        let play = |arm: Arm| (arm, seeds(arm).into_iter());
        let threads: Vec<_> =
            arms.into_iter().map(play).map(|(arm, seeds)| scope.spawn(move || self::play(arm, seeds))).collect();
        threads.into_iter().flat_map(|thread| thread.join().unwrap()).collect()
    });
    assert!(broken.is_empty(), "{} rules broken:\n{}", broken.len(), broken.join("\n"));
}
