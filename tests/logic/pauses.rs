//! A run that pauses at full speed: no ticks, no setpoints, no states for some milliseconds, or messages that get lost.
//! In virtual time, for every row at every tick rate, against a model of each controller's reaction to silence. The
//! motion is a straight line of the joints, so whatever leaves the line, or goes back on it, is seen.
//! `DIMOS_PAUSE=123 cargo test --test logic pauses::one -- --nocapture` shows a case. `make pauses` runs many.

use std::collections::BTreeMap;
use std::time::Duration;

use dimos::arm::{ArmState, Commanded, Link, VelocitySource};
use dimos::clock::Mono;
use dimos::control::config::*;
use dimos::control::coordinator::{Coordinator, TickTime};
use dimos::control::request::{Envelope, Request};
use dimos::control::task_spec::TaskTable;
use dimos::joint::{ControlMode, joints_of};
use dimos::robot::random::Random;
use dimos::telemetry::{Cause, Outcome, Phase, TaskState, TaskView};

use crate::support::arm_rows::{Row, rows};
use crate::support::gap_arm::{GapArm, STEP, Silence};
use crate::support::rig::{motion, task};

/// Pauses [ms]; 0 shows that the models alone break nothing.
const PAUSES: [u64; 9] = [0, 2, 5, 8, 12, 19, 25, 50, 90];
/// Shares of messages that are lost: setpoints, states.
const LOSSES: [(f64, f64); 4] = [(0.005, 0.0), (0.02, 0.0), (0.0, 0.005), (0.0, 0.02)];
/// Off the path, at a reach of 1 m [rad], and back along it [rad].
const OFF: f64 = 0.002;
const BACK: f64 = 0.0005;

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

struct Run {
    row: Row,
    period: f64,
    coordinator: Coordinator,
    arm: GapArm,
    state: ArmState,
    /// Time of the next deadline, and of the arm [ms].
    deadline: u64,
    elapsed: u64,
    inbox: Vec<Envelope>,
    outcome: Option<Outcome>,
    task: TaskView,
    phase: (Phase, Cause),
    stop_seq: u32,
    /// From where to where the motion goes.
    from: Vec<f64>,
    to: Vec<f64>,
    /// The last setpoint that was written: its time [s], positions, velocities.
    wire: Option<(f64, f64, Vec<f64>, Vec<f64>)>,
    /// The controller has come to rest by itself: setpoints start from rest.
    from_rest: bool,
    /// Longest time without a setpoint that is bridged [s], and how often it was exceeded.
    tolerance: f64,
    rests: f64,
    /// Furthest along the path: joints, setpoints [rad].
    furthest: (f64, f64),
    /// What is allowed beside the path and back along it because of the controller [rad].
    own: (f64, f64),
    broken: BTreeMap<&'static str, (f64, String)>,
    verbose: bool,
}

impl Run {
    fn new(row: &Row, rate: f64, random: &mut Random) -> Self {
        let row = row.at(rate);
        let s = &row.arm.supervision;
        let params = TrajectoryParams { goal_tolerance: 0.02 + s.accuracy, ..TrajectoryParams::default() };
        let dof = row.arm.dof;
        let tasks = vec![task("t", TaskKind::new("trajectory", &params), 0..dof as u16, 10)];
        let config = CoordinatorConfig { version: CONFIG_VERSION, rate, arms: vec![row.arm.clone()], tasks };
        let from = row.middle();
        let l = &row.arm.limits;
        let to = (0..dof).map(|j| {
            let away = random.between(0.3, 1.2) * if random.below(2) == 0 { 1.0 } else { -1.0 };
            (from[j] + away).clamp(l.position_lower[j] + 0.05, l.position_upper[j] - 0.05)
        });
        let to = to.collect();
        Self {
            period: 1.0 / rate,
            coordinator: Coordinator::new(&config, TaskTable::builtin().build(&config.tasks).unwrap()),
            arm: GapArm::new(&row, &from, 1.0 / rate),
            state: ArmState::default(),
            deadline: 1000,
            elapsed: 1000,
            inbox: Vec::new(),
            outcome: None,
            task: TaskView::default(),
            phase: (Phase::Unknown, Cause::None),
            stop_seq: 0,
            from,
            to,
            wire: None,
            from_rest: false,
            tolerance: s.gap_tolerance.as_secs_f64().max(2.0 / rate),
            rests: 0.0,
            furthest: (f64::NEG_INFINITY, f64::NEG_INFINITY),
            own: (0.0, 0.0),
            broken: BTreeMap::new(),
            verbose: false,
            row,
        }
    }

    fn period_ms(&self) -> u64 {
        (self.period * 1e3).round() as u64
    }

    /// Where a pose is along the motion, and how far beside it [rad].
    fn on_path(&self, q: &[f64]) -> (f64, f64) {
        let line: Vec<f64> = self.from.iter().zip(&self.to).map(|(a, b)| b - a).collect();
        let length = line.iter().map(|d| d * d).sum::<f64>().sqrt();
        let along = q.iter().zip(&self.from).zip(&line).map(|((q, a), d)| (q - a) * d).sum::<f64>() / length;
        let off = (q.iter().zip(&self.from).zip(&line)).map(|((q, a), d)| (q - a - along * d / length).abs());
        // Beyond its ends it is beside it, too.
        let beyond = (-along).max(along - length).max(0.0);
        (along, off.fold(beyond, f64::max))
    }

    fn breaks(&mut self, rule: &'static str, by: f64, text: impl FnOnce() -> String) {
        let found = self.broken.entry(rule).or_insert_with(|| (by, text()));
        found.0 = found.0.max(by);
    }

    /// Judges where the joints, or the setpoints, are.
    fn judge(&mut self, q: &[f64], setpoint: bool) {
        let (along, off) = self.on_path(q);
        let furthest = if setpoint { &mut self.furthest.1 } else { &mut self.furthest.0 };
        let back = *furthest - along;
        *furthest = furthest.max(along);
        let (what, at) = (if setpoint { "setpoint" } else { "joints" }, self.elapsed - 1000);
        let (beside, behind) = (OFF + self.own.0, BACK + self.own.1);
        if off > beside {
            let rule = if setpoint { "setpoint off path" } else { "joint off path" };
            self.breaks(rule, off, || format!("{what} {off:.4} rad off at {at} ms (limit {beside:.4})"));
        }
        if back > behind {
            let rule = if setpoint { "setpoint back" } else { "joint back" };
            self.breaks(rule, back, || format!("{what} {back:.4} rad back at {at} ms (limit {behind:.4})"));
        }
    }

    /// Judges whether a setpoint continues the one before, within the acceleration.
    fn continues(&mut self, at: Mono, values: Vec<f64>) {
        let at = at.0 as f64 * 1e-9;
        let Some((before, dt_before, last, speed)) = self.wire.take() else {
            let still = vec![0.0; values.len()];
            self.wire = Some((at, self.period, values, still));
            return;
        };
        let dt = at - before;
        if dt > self.tolerance + 1e-9 && !self.from_rest {
            (self.from_rest, self.rests) = (true, self.rests + 1.0);
        }
        let mut velocity = vec![0.0; values.len()];
        for j in 0..values.len() {
            velocity[j] = (values[j] - last[j]) / dt;
            let speed = if self.from_rest { 0.0 } else { speed[j] };
            let most = self.row.arm.limits.acceleration_max[j] * 0.5 * (dt + dt_before);
            let change = (velocity[j] - speed).abs();
            if change > 1.1 * most + 1e-6 {
                let (ms, v) = (self.elapsed - 1000, velocity[j]);
                self.breaks("setpoint step", change / most, || {
                    format!("joint {j}: {speed:.4} to {v:.4} rad/s at {ms} ms: {:.1} times its limit", change / most)
                });
            }
        }
        self.from_rest = false;
        self.wire = Some((at, dt, values, velocity));
    }

    /// Time passes for the arm [ms].
    fn pass(&mut self, ms: u64) {
        for _ in 0..ms {
            self.arm.step();
            self.elapsed += 1;
            self.judge(&self.arm.q.clone(), false);
        }
    }

    /// The next tick, so late [ms]. `lost`: its setpoint, the state before it.
    fn tick(&mut self, late: u64, lost: (bool, bool)) {
        let period = self.period_ms();
        let skipped = late / period;
        self.deadline += period * (skipped + 1);
        let real = self.deadline + late % period;
        self.pass(real - self.elapsed);
        let now = Mono(self.deadline * 1_000_000);
        if !lost.1 {
            let commanded = Commanded { position: joints_of(&self.arm.r), velocity: joints_of(&self.arm.v) };
            self.state = ArmState {
                seq: self.state.seq + 1,
                stamp: Mono(self.elapsed * 1_000_000 - 500_000),
                dof: self.arm.q.len(),
                position: joints_of(&self.arm.q),
                velocity: joints_of(&self.arm.dq),
                velocity_source: VelocitySource::Measured,
                mode: ControlMode::ServoPosition,
                enabled: true,
                error: self.arm.error,
                link: Link::Up,
                commanded: (self.arm.silence != Silence::Rests).then_some(commanded),
                written: self.state.written,
                ..ArmState::default()
            };
        }
        let time = TickTime {
            now,
            next: now.after(Duration::from_millis(period)),
            skipped: skipped as u32,
            late_ns: if skipped > 0 { late * 1_000_000 } else { 0 },
            woke_late_ns: late * 1_000_000,
        };
        let inbox = &mut self.inbox;
        let output = self.coordinator.tick(time, &[self.state], || inbox.pop());
        let command = output.commands[0];
        self.task = output.tasks[0];
        self.phase = (output.arms[0].phase, output.arms[0].cause);
        for event in &output.events {
            if let dimos::telemetry::Event::Request(_, outcome) = event {
                self.outcome = Some(*outcome);
            }
            if self.verbose {
                println!("{:6} ms {event:?}", self.elapsed - 1000);
            }
        }
        if self.verbose {
            let (q, s) = (self.on_path(&self.arm.q), self.on_path(&command.values[..self.arm.q.len()]));
            let at = self.elapsed - 1000;
            println!(
                "{at:6} ms late {late} joints {:.4} {:.5} setpoint {:.4} {:.5} {:?}",
                q.0, q.1, s.0, s.1, self.phase
            );
        }
        if command.stop_seq != self.stop_seq {
            self.stop_seq = command.stop_seq;
            self.arm.stop();
        }
        if command.mode.is_some() && !lost.0 && self.arm.error == 0 {
            let values = command.values[..self.arm.q.len()].to_vec();
            self.arm.write(&values);
            self.state.written = command.seq;
            self.judge(&values, true);
            self.continues(command.at, values);
        }
    }

    fn ask(&mut self, request: Request) {
        self.inbox.push(Envelope { id: 1, request });
        self.tick(0, (false, false));
    }
}

/// Plays a case of a seed. Returns the rules that it broke.
fn play(seed: u64, verbose: bool) -> (String, BTreeMap<&'static str, (f64, String)>) {
    let cases = cases();
    let (index, rate, gap) = cases[(seed % cases.len() as u64) as usize];
    let mut random = Random::new(seed);
    let mut run = Run::new(&rows()[index], rate, &mut random);
    run.verbose = verbose;
    let what = format!("{} at {rate} Hz, {gap:?}", run.row.name);
    (0..3).for_each(|_| run.tick(0, (false, false)));
    run.ask(Request::Enabled { arm: 0 });
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
                let beyond = run.period + pause > run.tolerance + 1e-9;
                run.rests += f64::from(u8::from(beyond));
                // What the controller does by itself, in this pause and, beyond its tolerance, until it rests.
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
