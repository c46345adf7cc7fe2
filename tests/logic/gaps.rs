//! A run that gets no processor for less than 0.1 s while its arm moves: the arm stops on its own beyond the last
//! setpoint and returns, and the motion continues there, from rest. However fast it is, and whatever gap follows, that
//! is no tracking error, and the arm follows its setpoints afterwards.

use std::time::Duration;

use dimos::control::config::ArmConfig;
use dimos::hardware::sim::plant::Plant;
use dimos::joint::JointLimits;
use dimos::telemetry::{Phase, TaskState};

use crate::support::rig::*;

/// YourArm's fastest joint: half the range [rad], speed [rad/s], acceleration [rad/s²], jerk [rad/s³].
const HALF_RANGE: f64 = 4.7;
const SPEED: f64 = 6.3;
const ACCELERATION: f64 = 10.0;
const JERK: f64 = 100.0;
/// Lags of emulated arms [s].
const LAGS: [f64; 2] = [0.03, 0.1];
/// The motion: both ends [rad] and duration [s].
const END: f64 = 4.0;
const DURATION: f64 = 2.3;
const PERIOD: f64 = 0.01;

fn limits() -> JointLimits {
    JointLimits {
        acceleration_max: vec![ACCELERATION],
        jerk_max: vec![JERK],
        ..JointLimits::uniform(1, HALF_RANGE, SPEED)
    }
}

/// The arm behind a run with this lag; setpoints, as long as the run computes.
struct Bench {
    rig: Rig,
    plant: Plant,
}

impl Bench {
    fn new(lag: f64) -> Self {
        let mut config = ArmConfig { limits: limits(), ..arm("arm", 1) };
        (config.supervision.lag, config.supervision.accuracy) = (lag, 0.002);
        config.supervision.stale_after = Duration::from_millis(50);
        let mut rig = Rig::new(1.0 / PERIOD, vec![config], vec![task("t", trajectory(), 0..1, 10)]);
        let mut plant = Plant::lagging(&limits(), &[-END], lag);
        plant.enable(true);
        rig.arms[0].q = vec![-END];
        rig.make_ready();
        Self { rig, plant }
    }

    /// Ticks after `skipped` periods without one. `old`: the newest state is from before them.
    fn tick(&mut self, skipped: u32, old: bool) {
        self.plant.advance(PERIOD * f64::from(skipped + 1));
        let rig = &mut self.rig;
        rig.now = rig.now.after(rig.config.period() * (skipped + 1));
        rig.arms[0].q = vec![self.plant.positions()[0]];
        rig.arms[0].v = vec![self.plant.velocities()[0]];
        rig.arms[0].silent = old;
        let states = [rig.arms[0].observe(rig.now)];
        rig.tick_with(&states, skipped);
        let command = rig.commands[0];
        rig.arms[0].mode = command.mode.unwrap_or(rig.arms[0].mode);
        if command.mode.is_some() {
            self.plant.servo(&command.values[..1]);
            let arm = &mut rig.arms[0];
            arm.state.written = command.seq;
            arm.written = Some(command.values[..1].to_vec());
            (arm.written_at, arm.written_start) = (command.at, command.start_seq);
        }
    }
}

/// Moves from one end to the other with gaps: after how many ticks, how many periods long.
fn moves_through(gaps: &[(u32, u32)], lag: f64, old: bool) -> Result<(), String> {
    let mut bench = Bench::new(lag);
    bench.rig.execute(0, sweep(1, 0..1, -END, END, DURATION));
    for (ticks, skipped) in gaps {
        (0..*ticks).for_each(|_| bench.tick(0, false));
        bench.tick(*skipped, old);
    }
    let mut behind = 0.0f64;
    for _ in 0..600 {
        bench.tick(0, false);
        // It is where its setpoints were, and that it returned does not count.
        if bench.rig.speed(0) > 0.5 {
            behind = behind.max(bench.rig.commanded(0)[0] - bench.plant.positions()[0] - lag * SPEED);
        }
        if bench.rig.tasks[0].state != TaskState::Executing {
            break;
        }
    }
    let (task, phase) = (&bench.rig.tasks[0], bench.rig.phase(0));
    let well = task.state == TaskState::Completed && phase == Phase::Ready && behind < 0.05;
    let why = || {
        format!(
            "{gaps:?} (lag {lag}, old: {old}): {task:?}, {phase:?} {:?}, behind {behind}",
            bench.rig.samples[0].cause
        )
    };
    if well { Ok(()) } else { Err(why()) }
}

fn all_move(cases: impl Iterator<Item = Vec<(u32, u32)>>) {
    let (mut all, mut failed) = (0, Vec::new());
    for gaps in cases {
        for (lag, old) in LAGS.into_iter().flat_map(|lag| [(lag, false), (lag, true)]) {
            all += 1;
            failed.extend(moves_through(&gaps, lag, old).err());
        }
    }
    assert!(failed.is_empty(), "{} of {all} motions ended: {}", failed.len(), failed[..failed.len().min(5)].join("\n"));
}

#[test]
fn a_gap_at_any_time_of_a_motion_ends_none() {
    all_move((5..220).step_by(5).flat_map(|ticks| [3, 5, 7, 8].map(|skipped| vec![(ticks, skipped)])));
}

#[test]
fn two_gaps_in_a_row_end_no_motion() {
    let first = (15..200).step_by(12);
    all_move(first.flat_map(|ticks| {
        [(2, 4), (4, 8), (6, 4), (9, 6), (14, 8), (25, 5), (40, 8)]
            .into_iter()
            .flat_map(move |(between, second)| [2, 6].map(|skipped| vec![(ticks, skipped), (between, second)]))
    }));
}
