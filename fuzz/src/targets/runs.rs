//! Sequences of requests to a run in virtual time.

#[path = "../../../tests/support/rig.rs"]
#[allow(dead_code, missing_docs, clippy::unwrap_used, reason = "of the tests")]
mod rig;
#[path = "../../../tests/support/sim_arm.rs"]
#[allow(dead_code, missing_docs, reason = "of the tests")]
mod sim_arm;

use dimos::control::request::Request;
use dimos::joint::joints_of;
use dimos::telemetry::{Event, TaskState};

use rig::{Rig, arm, servo, sweep, task, trajectory, velocity};

use crate::bytes::Bytes;
use crate::{Target, bug};

/// Requests between ticks, and what happens to arms meanwhile.
pub const REQUESTS: Target = Target {
    name: "requests",
    about: "every command within limits, no motion unasked, an answer for each request",
    run: requests,
    seeds: || (0_u8..4).map(|n| (0_u8..120).map(|i| i.wrapping_mul(41 + 2 * n) ^ n).collect()).collect(),
};

/// Longest sequence.
const MOST: usize = 80;
/// Ticks in which an arm without an active task may still brake, or take a setpoint back towards a blocked joint.
const SETTLED: u32 = 150;
/// A setpoint that moves by less rests [rad].
const RESTS: f64 = 1e-9;

fn requests(data: &[u8]) {
    let mut from = Bytes(data);
    let tasks = vec![
        task("path", trajectory(), 0..7, 10),
        task("stream", servo(), 0..7, 20),
        task("speeds", velocity(), 0..7, 30),
        task("other", trajectory(), 7..13, 10),
    ];
    let mut rig = Rig::new(100.0, vec![arm("left", 7), arm("right", 6)], tasks);
    rig.make_ready();
    let (mut ids, mut quiet, mut stops) = (Vec::new(), 0_u32, 0);
    for number in 0..MOST {
        if from.is_empty() {
            break;
        }
        let which = u16::from(from.byte() & 1);
        let request = match from.below(20) {
            0 => Request::Execute {
                task: 0,
                motion: sweep(1000 + number as u64, 0..7, at(&rig, 0), from.between(-1.8, 1.8), from.between(0.5, 4.0)),
            },
            1 => Request::Execute {
                task: 3,
                motion: sweep(
                    2000 + number as u64,
                    7..13,
                    at(&rig, 1),
                    from.between(-1.8, 1.8),
                    from.between(0.5, 4.0),
                ),
            },
            2 => Request::Servo { task: 1, target: joints_of(&[(); 7].map(|()| from.number())) },
            3 => Request::Velocity { task: 2, target: joints_of(&[(); 7].map(|()| from.number())) },
            4 => Request::Cancel { task: [None, Some(u16::from(from.byte() & 3))][from.below(2)] },
            5 => {
                stops += 1;
                Request::Stop { arm: [None, Some(which)][from.below(2)] }
            }
            6 => Request::Reset { arm: which },
            7 => Request::Enabled { arm: which, outside: from.byte() & 1 == 1 },
            8 => Request::PrepareDisable { arm: which },
            9 => Request::EndNative { arm: which },
            10 => Request::Gripper { arm: which, opening: from.number(), force: None, speed: None },
            11 => Request::Speed { fraction: from.number() },
            12 => Request::Pause { on: from.byte() & 1 == 1 },
            13 => Request::LeaseTaken { arm: which, client: u64::from(from.byte() & 3) },
            14 => Request::LeaseEnded { arm: which, client: u64::from(from.byte() & 3) },
            15 => {
                rig.arms[usize::from(which)].blocked ^= true;
                quiet = 0;
                continue;
            }
            16 => {
                rig.arms[usize::from(which)].silent ^= true;
                quiet = 0;
                continue;
            }
            17 => {
                tick(&mut rig, &mut quiet, from.below(4) as u32);
                continue;
            }
            _ => {
                for _ in 0..=from.byte() {
                    tick(&mut rig, &mut quiet, 0);
                }
                continue;
            }
        };
        ids.push(rig.send(request));
        quiet = 0;
        tick(&mut rig, &mut quiet, 0);
        bug(1, stops >= 3);
    }
    rig.arms.iter_mut().for_each(|arm| (arm.silent, arm.blocked) = (false, false));
    quiet = 0;
    for _ in 0..20 {
        tick(&mut rig, &mut quiet, 0);
    }
    for id in &ids {
        let answered = rig.events.iter().any(|(_, event)| matches!(event, Event::Request(of, _) if of == id));
        assert!(answered, "request {id} has no answer");
    }
    bug(2, ids.len() > 25);
    bug(3, rig.tasks.iter().filter(|task| task.state == TaskState::Executing).count() >= 2);
}

/// Where the first joint of an arm is commanded to be [rad].
fn at(rig: &Rig, arm: usize) -> f64 {
    rig.arms[arm].q.first().copied().unwrap_or_default()
}

/// One tick, after skipped ones; an arm that nothing moves does not move.
fn tick(rig: &mut Rig, quiet: &mut u32, skipped: u32) {
    let before: Vec<Vec<f64>> = rig.commands.iter().map(|command| command.values.to_vec()).collect();
    let modes: Vec<_> = rig.commands.iter().map(|command| command.mode).collect();
    rig.tick_after(skipped);
    let active = |state: TaskState| matches!(state, TaskState::Executing | TaskState::Cancelling);
    *quiet = if rig.tasks.iter().any(|task| active(task.state)) { 0 } else { *quiet + 1 };
    if *quiet < SETTLED {
        return;
    }
    for ((command, before), mode) in rig.commands.iter().zip(&before).zip(modes) {
        if command.mode.is_some() && command.mode == mode {
            let moved = command.values.iter().zip(before).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(moved <= RESTS, "a setpoint moves by {moved} rad, and nothing is asked");
        }
    }
}
