//! A coordinator that commands a straight line of the joints, and what a controller makes of it while the run pauses:
//! whatever leaves the line, or goes back on it, is found.

#![allow(clippy::needless_range_loop, reason = "joints are indices into several arrays at once")]

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
use dimos::telemetry::{Cause, Event, Outcome, Phase, TaskView};

use super::arm_rows::Row;
use super::gap_arm::{GapArm, Silence};
use super::rig::task;

/// Off the path, at a reach of 1 m [rad], and back along it [rad].
const OFF: f64 = 0.002;
const BACK: f64 = 0.0005;

/// Rules that were broken: by how much at worst, and the first time in words.
pub type Broken = BTreeMap<&'static str, (f64, String)>;

/// A run between a coordinator and a controller, on a virtual clock.
pub struct Run {
    pub row: Row,
    pub period: f64,
    pub coordinator: Coordinator,
    pub arm: GapArm,
    pub state: ArmState,
    /// Time of the next deadline, and of the arm [ms].
    pub deadline: u64,
    pub elapsed: u64,
    pub inbox: Vec<Envelope>,
    pub outcome: Option<Outcome>,
    pub task: TaskView,
    pub phase: (Phase, Cause),
    pub stop_seq: u32,
    /// From where to where the motion goes.
    pub from: Vec<f64>,
    pub to: Vec<f64>,
    /// The last setpoint that was written: its time [s], positions, velocities.
    pub wire: Option<(f64, f64, Vec<f64>, Vec<f64>)>,
    /// The controller is at rest after the gap: setpoints start from rest.
    pub from_rest: bool,
    /// Longest time without a setpoint that is bridged [s], and how often it was exceeded.
    pub tolerance: f64,
    pub rests: f64,
    /// Furthest along the path: joints, setpoints [rad].
    pub furthest: (f64, f64),
    /// What is allowed beside the path and back along it because of the controller [rad].
    pub own: (f64, f64),
    pub broken: Broken,
    pub verbose: bool,
}

impl Run {
    pub fn new(row: &Row, rate: f64, random: &mut Random) -> Self {
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
    pub fn on_path(&self, q: &[f64]) -> (f64, f64) {
        let line: Vec<f64> = self.from.iter().zip(&self.to).map(|(a, b)| b - a).collect();
        let length = line.iter().map(|d| d * d).sum::<f64>().sqrt();
        let along = q.iter().zip(&self.from).zip(&line).map(|((q, a), d)| (q - a) * d).sum::<f64>() / length;
        let off = (q.iter().zip(&self.from).zip(&line)).map(|((q, a), d)| (q - a - along * d / length).abs());
        // Beyond its ends it is beside it, too.
        let beyond = (-along).max(along - length).max(0.0);
        (along, off.fold(beyond, f64::max))
    }

    pub fn breaks(&mut self, rule: &'static str, by: f64, text: impl FnOnce() -> String) {
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
    pub fn tick(&mut self, late: u64, lost: (bool, bool)) {
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
            if let Event::Request(_, outcome) = event {
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

    pub fn ask(&mut self, request: Request) {
        self.inbox.push(Envelope { id: 1, origin: None, request });
        self.tick(0, (false, false));
    }
}
