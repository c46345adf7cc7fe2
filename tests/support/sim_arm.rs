//! An arm in memory, for tests on a virtual clock.

#![allow(clippy::needless_range_loop, reason = "joints are indices into several arrays at once")]

use std::time::Duration;

use dimos::arm::{ArmCommand, ArmState, Link, VelocitySource};
use dimos::clock::Mono;
use dimos::joint::{ControlMode, joints_of};

/// An arm in memory: follows what it is commanded, with the imperfections it is given.
#[derive(Debug, Clone)]
pub struct SimArm {
    pub dof: usize,
    /// Joint positions [rad].
    pub q: Vec<f64>,
    /// Joint velocities [rad/s].
    pub v: Vec<f64>,
    /// Time constant of a first-order lag behind the command [s]; 0 = none.
    pub lag: f64,
    /// How far gravity pulls each joint below its setpoint [rad].
    pub sag: f64,
    /// Whether it reports velocities.
    pub reports_velocity: bool,
    /// Ticks until a commanded mode is in effect.
    pub mode_delay: u32,
    /// Whether a stop makes its current position its setpoint.
    pub stop_takes_hold: bool,
    /// The joints do not move, whatever is commanded.
    pub blocked: bool,
    /// It reports no new states.
    pub silent: bool,
    /// Commands do not reach it.
    pub deaf: bool,
    /// How old a state is when the tick reads it.
    pub age: Duration,
    pub enabled: bool,
    pub error: i32,
    pub link: Link,
    pub self_held: bool,
    pub mode: ControlMode,
    /// Commanded positions or velocities [rad or rad/s]; `None`: never commanded.
    pub setpoint: Option<Vec<f64>>,
    pub state: ArmState,
    pub stops: u32,
    pub gripper: f64,
    /// The last setpoints that reached it, and the tick's time of them.
    pub written: Option<Vec<f64>>,
    pub written_at: Mono,
    pub written_start: u32,
    switching: u32,
    last: ArmCommand,
}

impl SimArm {
    pub fn new(dof: usize) -> Self {
        Self {
            dof,
            q: vec![0.0; dof],
            v: vec![0.0; dof],
            lag: 0.0,
            sag: 0.0,
            reports_velocity: true,
            mode_delay: 0,
            stop_takes_hold: false,
            blocked: false,
            silent: false,
            deaf: false,
            age: Duration::from_millis(1),
            enabled: true,
            error: 0,
            link: Link::Up,
            self_held: false,
            mode: ControlMode::Position,
            setpoint: None,
            state: ArmState::default(),
            stops: 0,
            gripper: 0.0,
            written: None,
            written_at: Mono::ZERO,
            written_start: 0,
            switching: 0,
            last: ArmCommand::default(),
        }
    }

    /// Returns the state that the tick reads.
    pub fn observe(&mut self, now: Mono) -> ArmState {
        if !self.silent {
            self.state.seq += 1;
            self.state.stamp = now.before(self.age);
            self.state.position = joints_of(&self.q);
            self.state.velocity = if self.reports_velocity { joints_of(&self.v) } else { joints_of(&[]) };
            self.state.velocity_source =
                if self.reports_velocity { VelocitySource::Measured } else { VelocitySource::Absent };
        }
        self.state.dof = self.dof;
        self.state.mode = self.mode;
        self.state.enabled = self.enabled;
        self.state.error = self.error;
        self.state.link = self.link;
        self.state.self_held = self.self_held;
        self.state
    }

    /// Executes a command for one period.
    pub fn execute_command(&mut self, command: &ArmCommand, dt: f64) {
        if command.stop_seq != self.last.stop_seq {
            self.stops += 1;
            if self.stop_takes_hold {
                self.setpoint = Some(self.q.clone());
            }
            if self.mode == ControlMode::Velocity {
                self.setpoint = None;
            }
        }
        if command.gripper_seq != self.last.gripper_seq {
            self.gripper = command.gripper;
        }
        self.last = *command;
        if let Some(mode) = command.mode.filter(|_| self.enabled && self.link == Link::Up && !self.deaf) {
            if mode != self.mode {
                self.switching += 1;
                if self.switching > self.mode_delay {
                    (self.mode, self.switching) = (mode, 0);
                }
            }
            if mode == self.mode {
                self.state.written = command.seq;
                self.written = Some(command.values[..self.dof].to_vec());
                (self.written_at, self.written_start) = (command.at, command.start_seq);
                self.setpoint = Some(command.values[..self.dof].to_vec());
            }
        }
        for j in 0..self.dof {
            let command = self.setpoint.as_ref().map(|s| s[j]);
            let share = if self.lag > 0.0 { 1.0 - (-dt / self.lag).exp() } else { 1.0 };
            let next = match (self.mode, command) {
                _ if self.blocked || !self.enabled => self.q[j],
                (_, None) => self.q[j],
                (ControlMode::Velocity, Some(v)) => {
                    let v = v * self.state.speed_fraction.unwrap_or(1.0);
                    let v = self.v[j] + share * (v - self.v[j]);
                    self.q[j] + v * dt
                }
                (_, Some(q)) => self.q[j] + share * (q - self.sag - self.q[j]),
            };
            self.v[j] = (next - self.q[j]) / dt;
            self.q[j] = next;
        }
    }
}
