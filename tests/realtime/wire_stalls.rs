//! Commands to an arm whose wire stalls at full speed, judged on the wire: six arms, every kind of stall,
//! from 20 ms to 3 s. `DIMOS_WIRE=full` tries every kind with every length; otherwise each arm gets every kind and
//! every length at least once. `DIMOS_WIRE_ARM=xarm` tries only that arm, and prints what went over the wire at a
//! failure.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use dimos::hardware::sim::faults::{Fault, FaultKind};

use crate::serial;
use crate::support::wire;
use crate::support::wire::arms::{Arm, Bed, PERIOD, PIPER, REMOTE, Setup, UR, XARM, YOURARM};
use crate::support::wire::watch::Watch;
use crate::support::wire::{Stall, now};

/// What stalls.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Wire(Stall),
    /// The arm's controller: it neither reads nor sends, then continues.
    Controller,
}

const KINDS: [Kind; 6] = [
    Kind::Wire(Stall::Both),
    Kind::Wire(Stall::ToArm),
    Kind::Wire(Stall::FromArm),
    Kind::Wire(Stall::Drop),
    Kind::Wire(Stall::Trickle),
    Kind::Controller,
];
const TIMES: [u64; 5] = [20, 60, 90, 300, 3000];
/// A failed case during which this computer ran no program for longer was not judged, and is repeated. Any other
/// failure is final.
const SPOILT: Duration = Duration::from_millis(4);
/// Maximum repetitions of a case. The last result counts, whatever this computer did.
const REPETITIONS: usize = 5;

fn arms() -> Vec<Arm> {
    let all = [YOURARM, XARM, PIPER, REMOTE, wire::arms::serial(&serial::SPEC), UR];
    let only = std::env::var("DIMOS_WIRE_ARM").ok();
    all.into_iter().filter(|arm| only.as_ref().is_none_or(|only| only == arm.name)).collect()
}

/// The cases of arm number `n`; all arms together cover more cases than each.
fn cases(n: usize) -> Vec<(Kind, Duration)> {
    let full = std::env::var("DIMOS_WIRE").is_ok_and(|v| v == "full");
    let all =
        KINDS.iter().enumerate().flat_map(|(k, kind)| TIMES.iter().enumerate().map(move |(t, ms)| (k, kind, t, ms)));
    // Every kind has one length of its own for this arm, and a cut of both ways has those that hurt most.
    let some = all.filter(|(k, kind, t, _)| {
        full || (k + n) % (TIMES.len() - 1) == *t || (**kind == Kind::Wire(Stall::Both) && *t >= 3)
    });
    some.map(|(_, kind, _, ms)| (*kind, Duration::from_millis(*ms))).collect()
}

/// Runs the cases of all arms, the arms side by side, and reports all failures.
fn judge_all(arms: &[Arm], case: fn(&Bed, Kind, Duration) -> Vec<String>) {
    let (realtime, ordinary) = (Watch::of_emulators(), Watch::of_programs());
    let failures: Vec<String> = std::thread::scope(|scope| {
        let threads: Vec<_> = arms
            .iter()
            .enumerate()
            .map(|(n, arm)| {
                // The kernel passes on the bytes of a pseudo-terminal in an ordinary thread.
                let watch = if arm.name == serial::SPEC.name { &ordinary } else { &realtime };
                scope.spawn(move || {
                    let bed = Bed::new(*arm, &Setup::default());
                    let mut failures = Vec::new();
                    for (kind, time) in cases(n) {
                        let mut found = Vec::new();
                        for _ in 0..REPETITIONS {
                            let began = Instant::now();
                            found = catch_unwind(AssertUnwindSafe(|| case(&bed, kind, time))).unwrap_or_else(said);
                            if found.is_empty() || watch.longest_since(began) < SPOILT {
                                break;
                            }
                        }
                        println!("{:8} {kind:?} {time:?}: {found:?}", arm.name);
                        failures.extend(found.into_iter().map(|f| format!("{} {kind:?} {time:?}: {f}", arm.name)));
                    }
                    failures
                })
            })
            .collect();
        threads.into_iter().flat_map(|thread| thread.join().unwrap()).collect()
    });
    assert!(failures.is_empty(), "{} failures:\n{}", failures.len(), failures.join("\n"));
}

/// What a case said that came to no end.
fn said(panic: Box<dyn std::any::Any + Send>) -> Vec<String> {
    vec![panic.downcast_ref::<String>().cloned().unwrap_or_else(|| "panicked".to_owned())]
}

fn begin(bed: &Bed, kind: Kind, time: Duration) -> dimos::clock::Mono {
    match kind {
        Kind::Wire(stall) => bed.gate.stall(stall, time),
        Kind::Controller => {
            bed.inject(Fault::new(FaultKind::Stall).lasting(time.as_secs_f64()));
            now()
        }
    }
}

/// Whether the arm's states stop coming in such a stall for longer than they may.
fn must_hold(arm: &Arm, kind: Kind, time: Duration) -> bool {
    let silent = matches!(kind, Kind::Controller | Kind::Wire(Stall::Both | Stall::FromArm | Stall::Drop));
    silent && time.as_secs_f64() > arm.stale_after() + 3.0 * PERIOD
}

fn position_case(bed: &Bed, kind: Kind, time: Duration) -> Vec<String> {
    bed.at_full_speed();
    let began = begin(bed, kind, time);
    std::thread::sleep(time);
    bed.rest();
    let (phase, cause) = bed.phase();
    let (sent, delivered) = (bed.gate.sent(), bed.delivered(began));
    let mut verdicts = vec![bed.bounds.neighbours(&sent, began)];
    // A run hears of no frame that its bus took and somebody behind it lost.
    if kind != Kind::Wire(Stall::Drop) || bed.arm.name != "piper" {
        verdicts.push(bed.bounds.windows(&delivered, began));
    }
    if kind != Kind::Wire(Stall::Drop) {
        verdicts.push(bed.bounds.neighbours(&delivered, began).map_err(|e| format!("delivered: {e}")));
    }
    // Whatever else may have held it later.
    let by_the_stall = bed.bounds.moved_for(&sent, began) < time.as_secs_f64() + 0.6;
    if phase == "held" && by_the_stall {
        verdicts.push(bed.bounds.travel(&delivered, began));
    } else if must_hold(&bed.arm, kind, time) {
        verdicts.push(Err(format!("it is {phase} after {time:?} of silence")));
    }
    // A lost reply is awaited for longer than the stall.
    let lossless = !matches!(kind, Kind::Wire(Stall::Trickle | Stall::Drop));
    if phase == "held" && by_the_stall && lossless && time.as_secs_f64() < bed.bounds.stale_after {
        verdicts.push(Err(format!("held ({cause}) though no state was older than it may be")));
    }
    let failures: Vec<String> = verdicts.into_iter().filter_map(Result::err).collect();
    if !failures.is_empty() && std::env::var_os("DIMOS_WIRE_ARM").is_some() {
        println!("{phase} ({cause})");
        let near = |at: dimos::clock::Mono| (-0.05..time.as_secs_f64() + 0.1).contains(&at.seconds_since(began));
        for command in delivered.iter().filter(|command| near(command.at)) {
            println!("{:8.1} ms {:?} {:?}", command.at.seconds_since(began) * 1e3, command.what, command.truth);
        }
    }
    failures
}

fn velocity_case(bed: &Bed, kind: Kind, time: Duration) -> Vec<String> {
    let start: Vec<f64> = bed.arm.ends[0].iter().map(|q| q * 0.95).collect();
    // The stream of the case before keeps its joints at zero until it is cancelled; and the arm may be held on its way.
    // Only where the case begins depends on this.
    let at_start = || {
        bed.ready();
        let _ = bed.run.handle().cancel();
        let _ = bed.run.move_arm("arm", &start, 1.0).and_then(|m| bed.run.wait(m.motion));
        bed.rest();
        bed.truth().iter().zip(&start).all(|(q, start)| (q - start).abs() < 0.05)
    };
    if !(0..5).any(|_| at_start()) {
        return vec![format!("it is at {:?} and does not reach the start of the case", bed.truth())];
    }
    bed.ready();
    bed.rest();
    bed.gate.forget();
    let handle = bed.run.handle();
    let streaming = AtomicBool::new(true);
    // Where the tool's speed is limited, a joint that does not move the tool: the last one.
    let joint = if matches!(bed.arm.name, "xarm" | "ur") { 5 } else { 0 };
    std::thread::scope(|scope| {
        let (streaming, top) = (&streaming, bed.bounds.velocity[joint]);
        scope.spawn(move || {
            let mut target = vec![0.0; 6];
            target[joint] = top;
            let began = Instant::now();
            // Refused once it is held.
            while streaming.load(Ordering::Relaxed) && began.elapsed() < Duration::from_millis(900) {
                let _ = handle.velocity("velocity_arm", &target);
                std::thread::sleep(Duration::from_millis(8));
            }
        });
        bed.until("it moves at full speed, or is held", |bed| bed.is_fast() || bed.phase().0 == "held");
        let (began, from) = (begin(bed, kind, time), bed.truth());
        std::thread::sleep(time.max(Duration::from_millis(200)));
        if time < Duration::from_millis(200) {
            streaming.store(false, Ordering::Relaxed);
        }
        bed.rest();
        streaming.store(false, Ordering::Relaxed);
        let ((phase, cause), sent, delivered) = (bed.phase(), bed.gate.sent(), bed.gate.delivered());
        let held = phase == "held";
        let mut verdicts = vec![bed.bounds.neighbours(&sent, began)];
        if kind != Kind::Wire(Stall::Drop) {
            verdicts.push(bed.bounds.neighbours(&delivered, began).map_err(|e| format!("delivered: {e}")));
        }
        if held {
            // What was on its way may come late: it counts from then, and sets an arm that has stopped in motion once
            // more.
            let (limit, stall) = (bed.arm.time_limit.unwrap_or_default(), time.as_secs_f64());
            let again = if stall > limit { bed.bounds.stopping(joint, limit) } else { 0.0 };
            // A tracking error must last.
            let noticed = if cause == "tracking" { 0.11 } else { 0.0 };
            let delay = limit + bed.arm.stale_after().max(stall.min(limit)) + noticed;
            // The arm's own lag, too.
            let went = bed.bounds.went(&from, &bed.truth(), delay, again + 0.1, began);
            verdicts.push(went.map_err(|e| format!("held ({cause}): {e}")));
        } else if must_hold(&bed.arm, kind, time) {
            verdicts.push(Err(format!("it is {phase} after {time:?} of silence")));
        }
        verdicts.into_iter().filter_map(Result::err).collect()
    })
}

#[test]
fn a_stall_at_full_speed_makes_no_arm_jump_or_drives_it_on() {
    judge_all(&arms(), position_case);
}

#[test]
fn a_stall_in_velocity_mode_makes_no_arm_jump_or_drives_it_on() {
    let with_velocity: Vec<Arm> = arms().into_iter().filter(|arm| arm.time_limit.is_some()).collect();
    judge_all(&with_velocity, velocity_case);
}
