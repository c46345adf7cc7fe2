//! A true arm behind a device thread, in virtual time: drives with dead time, a lag, limits of their own, droop under
//! load; encoders with noise and resolution; a controller with its own answer to silence and to a stop. Shares nothing
//! with `dimos::control`.

#![allow(clippy::needless_range_loop, reason = "joints are indices into several arrays at once")]

use std::collections::VecDeque;
use std::time::Duration;

use dimos::arm::{AfterGap, ArmCommand, ArmState, Commanded, Link, VelocitySource};
use dimos::clock::Mono;
use dimos::joint::{ControlMode, Joints, MAX_DOF, joints_of};
use dimos::robot::random::Random;

use super::arm_rows::Row;
use super::arm_traits::{Traits, Velocities};

/// Longest step of the integration [s].
const STEP: f64 = 0.0025;
/// A velocity that is not commanded again ends after this [s].
const VELOCITY_EXPIRES: f64 = 0.15;

/// What the drives do.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Drive {
    Off,
    /// Hold or go to the setpoints.
    Follow,
    Velocity,
    /// Decelerate and rest where that ends.
    Brake,
}

/// The true arm.
#[derive(Debug, Clone)]
pub struct TrueArm {
    pub dof: usize,
    pub traits: Traits,
    /// True positions [rad] and velocities [rad/s].
    pub q: Vec<f64>,
    pub v: Vec<f64>,
    pub enabled: bool,
    pub error: i32,
    /// The next states do not arrive; the tick sees the last one again.
    pub silent: bool,
    /// Setpoints do not arrive.
    pub deaf: bool,
    /// Setpoints that were withheld.
    pub withheld: u32,
    /// Added to the readings: a recorded tracking behaviour.
    pub residual: Vec<f64>,
    /// The last setpoint that was written, its time and its start.
    pub written: Option<(Mono, Joints, ControlMode, u32)>,
    goal_only: bool,
    after_gap: AfterGap,
    gap_tolerance: f64,
    brake: Vec<f64>,
    accuracy: f64,
    droop_row: f64,
    limits_v: Vec<f64>,
    period: Duration,
    drive: Drive,
    mode: ControlMode,
    /// Setpoints on their way to the drive, and the one that it has with its rate.
    queue: VecDeque<(f64, Joints)>,
    target: Joints,
    rate: Joints,
    /// [s]
    time: f64,
    since_written: f64,
    seq: u64,
    state: ArmState,
    shown: Joints,
    last: ArmCommand,
    refused: u64,
}

impl TrueArm {
    pub fn new(row: &Row, traits: Traits, q: &[f64], period: Duration) -> Self {
        let s = &row.arm.supervision;
        Self {
            dof: row.arm.dof,
            q: q.to_vec(),
            v: vec![0.0; q.len()],
            enabled: false,
            error: 0,
            silent: false,
            deaf: false,
            withheld: 0,
            residual: vec![0.0; q.len()],
            written: None,
            goal_only: row.goal_only,
            after_gap: s.after_gap,
            gap_tolerance: s.gap_tolerance.as_secs_f64().max(2.0 * period.as_secs_f64()),
            brake: row.arm.limits.acceleration_max.clone(),
            accuracy: s.accuracy,
            droop_row: s.droop,
            limits_v: row.arm.limits.velocity_max.clone(),
            period: period.max(row.arm.write_period),
            drive: Drive::Off,
            mode: row.arm.position_mode().unwrap_or_default(),
            queue: VecDeque::new(),
            target: joints_of(q),
            rate: [0.0; MAX_DOF],
            time: 0.0,
            since_written: 0.0,
            seq: 0,
            state: ArmState::default(),
            shown: joints_of(q),
            last: ArmCommand::default(),
            refused: 0,
            traits,
        }
    }

    /// Switches the motors. The controller holds the joints where they are; a loaded joint sinks by its droop.
    pub fn switch(&mut self, on: bool) {
        if on == self.enabled {
            return;
        }
        self.enabled = on;
        self.drive = if on { Drive::Follow } else { Drive::Off };
        self.v.fill(0.0);
        self.queue.clear();
        (self.target, self.rate) = (joints_of(&self.q), [0.0; MAX_DOF]);
        self.written = None;
    }

    /// Returns whether the joints are at rest.
    pub fn at_rest(&self) -> bool {
        self.v.iter().all(|v| v.abs() < 0.01)
    }

    /// Returns the state as it is true for the encoders and the controller.
    pub fn observe(&mut self, now: Mono, random: &mut Random) -> ArmState {
        if self.silent {
            return self.state;
        }
        self.seq += 1;
        let t = &self.traits;
        let mut velocity = [0.0; MAX_DOF];
        for j in 0..self.dof {
            if self.seq == 1 || (self.seq + j as u64).is_multiple_of(t.stairs) {
                let q = self.q[j] + self.residual[j] + random.between(-1.0, 1.0) * t.noise;
                self.shown[j] = (q / t.resolution).round() * t.resolution;
            }
            velocity[j] = self.v[j] + random.between(-1.0, 1.0) * t.v_noise;
        }
        if t.velocities != Velocities::Measured {
            velocity = [0.0; MAX_DOF];
        }
        let absent = t.velocities == Velocities::Absent;
        let commanded = match self.drive {
            Drive::Follow => Commanded { position: self.target, velocity: self.rate },
            Drive::Velocity => Commanded { position: joints_of(&self.q), velocity: self.target },
            Drive::Off | Drive::Brake => Commanded { position: joints_of(&self.q), velocity: joints_of(&self.v) },
        };
        self.state = ArmState {
            seq: self.seq,
            stamp: now.before(Duration::from_secs_f64(t.age)),
            dof: self.dof,
            position: self.shown,
            velocity,
            velocity_source: if absent { VelocitySource::Absent } else { VelocitySource::Measured },
            mode: self.mode,
            enabled: self.enabled,
            error: self.error,
            link: Link::Up,
            written: self.state.written,
            commanded: t.reports_commanded.then_some(commanded),
            refused: self.refused,
            ..ArmState::default()
        };
        self.state
    }

    /// Takes a command as the device thread does, which has this reading.
    pub fn take(&mut self, command: &ArmCommand, reading: &ArmState) {
        if self.deaf {
            return;
        }
        if command.stop_seq != self.last.stop_seq {
            self.stop(command.rest);
        }
        self.last = *command;
        let Some(mode) = command.mode.filter(|_| self.enabled && self.error == 0) else { return };
        if !self.admits(command, mode, reading) {
            self.withheld += 1;
            self.refused = command.seq;
            return;
        }
        if mode != self.mode || (self.drive == Drive::Velocity) == mode.is_position() {
            // Until the first setpoint has reached the drive it holds.
            self.mode = mode;
            self.queue.clear();
            match mode.is_position() {
                true => self.rest_here(),
                false => (self.target, self.rate) = ([0.0; MAX_DOF], [0.0; MAX_DOF]),
            }
        }
        self.drive = if mode == ControlMode::Velocity { Drive::Velocity } else { Drive::Follow };
        self.state.written = command.seq;
        self.written = Some((command.at, command.values, mode, command.start_seq));
        self.since_written = 0.0;
        self.queue.push_back((self.time + self.traits.dead, command.values));
    }

    /// The last check before the wire: the first setpoint of a start is where the arm is, others are within limits.
    fn admits(&self, command: &ArmCommand, mode: ControlMode, reading: &ArmState) -> bool {
        let seed = self.accuracy.max(0.005).max(2.0 * self.accuracy);
        let near = |a: f64, b: f64, by: f64| (a - b).abs() <= by;
        match self.written.filter(|(.., m, start)| *m == mode && *start == command.start_seq) {
            Some((at, values, ..)) => {
                let time = command.at.since(at).min(2 * self.period).as_secs_f64();
                let limits = if mode == ControlMode::Velocity { &self.brake } else { &self.limits_v };
                (0..self.dof).all(|j| near(command.values[j], values[j], limits[j] * time * 1.00001 + 1e-6))
            }
            None if mode == ControlMode::Velocity => (0..self.dof).all(|j| command.values[j].abs() <= 0.2),
            None => (0..self.dof).all(|j| {
                let value = command.values[j];
                let own = reading.commanded.is_some_and(|own| near(value, own.position[j], seed));
                let repeats = self.written.is_some_and(|(_, last, m, _)| m.is_position() && near(last[j], value, 1e-9));
                let within = if repeats { seed + 2.0 * self.accuracy + self.droop_row } else { seed };
                own || near(value, reading.position[j], within)
            }),
        }
    }

    /// The controller's stop.
    fn stop(&mut self, rest: Option<Joints>) {
        if !self.enabled {
            return;
        }
        self.queue.clear();
        if self.goal_only {
            // It has goals only: the device thread writes where the arm is to rest.
            let goal = rest.or(self.written.map(|(_, values, ..)| values)).unwrap_or(self.target);
            (self.target, self.rate, self.drive) = (goal, [0.0; MAX_DOF], Drive::Follow);
        } else if self.drive == Drive::Follow && self.at_rest() {
            // Where the joints are, under the load that they have.
            self.rest_here();
        } else {
            self.drive = Drive::Brake;
        }
    }

    fn rest_here(&mut self) {
        self.drive = Drive::Follow;
        self.rate = [0.0; MAX_DOF];
        for j in 0..self.dof {
            self.target[j] = self.q[j] + self.traits.droop[j];
        }
    }

    /// Lets time pass [s].
    pub fn advance(&mut self, dt: f64) {
        let steps = (dt / STEP).ceil().max(1.0) as usize;
        (0..steps).for_each(|_| self.step(dt / steps as f64));
    }

    fn step(&mut self, h: f64) {
        self.time += h;
        self.since_written += h;
        while self.queue.front().is_some_and(|(at, _)| *at <= self.time + 1e-9) {
            let (_, values) = self.queue.pop_front().unwrap_or_default();
            let period = self.period.as_secs_f64();
            for j in 0..self.dof {
                self.rate[j] = if self.drive == Drive::Velocity { 0.0 } else { (values[j] - self.target[j]) / period };
            }
            self.target = values;
        }
        if self.queue.is_empty() && self.since_written > self.traits.dead + 2.0 * self.period.as_secs_f64() {
            self.rate = [0.0; MAX_DOF];
        }
        self.on_silence();
        for j in 0..self.dof {
            let (tau, a, top) = (self.traits.tau.max(1e-4), self.traits.a_max[j], self.traits.v_max[j]);
            let wanted = match self.drive {
                Drive::Off => {
                    self.v[j] = 0.0;
                    continue;
                }
                Drive::Follow => {
                    let error = self.target[j] - self.traits.droop[j] - self.q[j];
                    // A step of the goal is approached so that it can brake.
                    let most = self.rate[j].abs() + (2.0 * a * error.abs()).sqrt();
                    let share = (h / tau).min(1.0);
                    error.signum() * (share * error.abs() / h).min(most).min(top)
                }
                Drive::Velocity => {
                    let share = (h / tau).min(1.0);
                    (self.v[j] + share * (self.target[j] - self.v[j])).clamp(-top, top)
                }
                Drive::Brake => {
                    let change = self.brake[j] * h;
                    self.v[j] - self.v[j].clamp(-change, change)
                }
            };
            let change = a * h;
            self.v[j] += (wanted - self.v[j]).clamp(-change, change);
            self.q[j] += self.v[j] * h;
        }
        if self.drive == Drive::Brake && self.v.iter().all(|v| *v == 0.0) {
            self.rest_here();
        }
    }

    /// What the controller does when no setpoint comes while it moves.
    fn on_silence(&mut self) {
        let moving = !self.at_rest();
        match self.drive {
            Drive::Velocity if self.since_written > VELOCITY_EXPIRES && moving => self.drive = Drive::Brake,
            Drive::Follow if moving && self.since_written > self.gap_tolerance => match self.after_gap {
                AfterGap::RestsAtSetpoint => {}
                // At rest the target is no motion to end.
                _ if self.rate.iter().all(|rate| *rate == 0.0) => {}
                AfterGap::Decelerates => self.drive = Drive::Brake,
                AfterGap::Faults => (self.drive, self.error) = (Drive::Brake, 1),
            },
            _ => {}
        }
    }
}
