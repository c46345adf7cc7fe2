//! The arm behind an emulated controller, whatever its wire: joints with motors, one mode at a time, an error, an
//! E-stop line, and a script of faults. Everything is in SI units, and time is passed in.

use std::time::Duration;

pub use super::delivery::Delivery;
pub use super::options::{SimOptions, check_pose};
use crate::clock::Mono;
use crate::hardware::adapter::AdapterResult;
use crate::hardware::sim::faults::{FaultKind, FaultScript};
use crate::hardware::sim::plant::{Drive, Plant};
use crate::joint::{ControlMode, JointLimits, Joints, MAX_DOF};

/// Positions this close to a limit count as inside: numbers on the wire are rounded [rad].
const ROUNDING: f64 = 2e-5;
/// Goals of a servo that come closer together than this in time and angle are a stream [s, rad].
const STREAM: (f64, f64) = (0.1, 0.1);
/// Error code of the open E-stop line.
pub const ESTOP: u16 = 1;

/// The faults that a [`SimArm`] can play on a wire of bytes: those of the arm and those of [`SimArm::delivery`].
pub const PLAYABLE: &[FaultKind] = &[
    FaultKind::Stall,
    FaultKind::Silent,
    FaultKind::Disconnect,
    FaultKind::ErrorCode,
    FaultKind::Estop,
    FaultKind::PowerLoss,
    FaultKind::Nan,
    FaultKind::ZeroState,
    FaultKind::Garbage,
    FaultKind::Corrupt,
    FaultKind::Truncated,
    FaultKind::WrongDof,
    FaultKind::Sag,
    FaultKind::Blocked,
];

/// Why the arm does not do what it is told.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// The motors are off.
    Disabled,
    /// The arm is in another mode.
    WrongMode,
    /// The arm moves.
    Moving,
    /// A target is outside the limits.
    OutOfRange,
    /// The arm is in error.
    InError,
}

/// What an arm measures: joint positions [rad], velocities [rad/s], torques [Nm].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured {
    /// Joint positions [rad].
    pub positions: Joints,
    /// Joint velocities [rad/s].
    pub velocities: Joints,
    /// Joint torques [Nm].
    pub efforts: Joints,
}

/// An emulated controller with an arm behind it: what its server needs to be the arm's emulator.
pub trait HasArm {
    /// The arm.
    fn arm(&mut self) -> &mut SimArm;

    /// Brings everything up to `now`: the arm, and what else the controller has that moves.
    fn advance(&mut self, now: Mono) {
        self.arm().advance(now);
    }

    /// Joint positions [rad] and velocities [rad/s] as they truly are at `now`.
    fn joints_at(&mut self, now: Mono) -> (Joints, Joints) {
        self.advance(now);
        self.arm().joints()
    }
}

/// An arm that was just switched on: disabled, in position mode.
pub struct SimArm {
    name: &'static str,
    playable: &'static [FaultKind],
    plant: Plant,
    limits: JointLimits,
    /// How far outside its limits a target may be [rad].
    tolerance: f64,
    mode: ControlMode,
    /// It has modes; an arm without takes any command at any time.
    has_modes: bool,
    error: u16,
    estop_open: bool,
    /// When the E-stop line closes by itself.
    estop_until: Option<Mono>,
    /// In velocity mode the arm stops when no velocity arrives for this long.
    velocity_timeout: Option<Duration>,
    velocity_until: Option<Mono>,
    /// The goal of a servo [rad], and when it came.
    goal: Option<(Joints, Mono)>,
    script: FaultScript,
    /// Time zero of the script.
    first_client: Option<Mono>,
    powered_up: Mono,
    advanced_to: Mono,
}

impl SimArm {
    /// An arm within `limits`. Refuses options that it cannot follow; `playable` are the faults that its controller can
    /// play, `name` is the adapter's.
    pub fn new(
        name: &'static str,
        limits: &JointLimits,
        options: &SimOptions,
        playable: &'static [FaultKind],
        now: Mono,
    ) -> AdapterResult<Self> {
        options.check(name, limits, playable)?;
        let options = options.clone().starting_at(&pose_of_no_symmetry(limits));
        Ok(Self {
            name,
            playable,
            plant: Plant::lagging(limits, &options.initial_positions, options.lag).drooping(options.droop),
            limits: limits.clone(),
            tolerance: ROUNDING,
            mode: ControlMode::Position,
            has_modes: true,
            error: 0,
            estop_open: false,
            estop_until: None,
            velocity_timeout: None,
            velocity_until: None,
            goal: None,
            script: FaultScript::new(&options.faults),
            first_client: None,
            powered_up: now,
            advanced_to: now,
        })
    }

    /// The same arm with joints that move in another way.
    pub fn with_plant(mut self, plant: Plant) -> Self {
        self.plant = plant;
        self
    }

    /// The same arm, that in velocity mode stops when no velocity arrives within `timeout` [s].
    pub fn with_velocity_timeout(mut self, timeout: f64) -> Self {
        self.velocity_timeout = Some(Duration::from_secs_f64(timeout));
        self
    }

    /// The same arm, that takes targets up to `tolerance` [rad] outside its limits. Joints never leave their limits.
    pub fn with_tolerance(mut self, tolerance: f64) -> Self {
        self.tolerance = tolerance;
        self
    }

    /// The same arm without modes: it takes targets, setpoints and velocities at any time, as servos do.
    pub fn without_modes(mut self) -> Self {
        self.has_modes = false;
        self
    }

    /// From now on joints whose motors are off fall at `speed` [rad/s], each to its place in `rest` [rad]; one without
    /// stays where it is. Until then brakes, or somebody's hands, hold the arm.
    pub fn falls(&mut self, speed: f64, rest: &[Option<f64>]) {
        self.plant.falls(speed, rest);
    }

    // --- Time, power and clients ---

    /// Brings the joints up to `now`, and lets the faults of the arm happen that are due. Comes before anything else.
    pub fn advance(&mut self, now: Mono) {
        self.integrate(now);
        self.apply_faults();
    }

    /// Brings the joints up to `now`, without faults.
    pub fn integrate(&mut self, now: Mono) {
        if let Some(until) = self.velocity_until.filter(|until| *until < now) {
            self.pass(until);
            self.velocity_until = None;
            if self.plant.drive() == Drive::Velocity {
                self.plant.stop();
            }
        }
        self.pass(now);
        if self.estop_until.is_some_and(|until| now >= until) {
            self.release_estop();
        }
    }

    fn pass(&mut self, to: Mono) {
        self.plant.advance(to.seconds_since(self.advanced_to).max(0.0));
        self.advanced_to = to.max(self.advanced_to);
    }

    /// A client has connected: the first one is time zero of the script.
    pub fn client_came(&mut self) {
        self.first_client.get_or_insert(self.advanced_to);
    }

    /// The client is gone: the arm stops.
    pub fn client_gone(&mut self, now: Mono) {
        self.advance(now);
        self.plant.stop();
    }

    /// Opens the E-stop line: error, motors off.
    pub fn press_estop(&mut self) {
        self.estop_open = true;
        self.estop_until = None;
        self.error = ESTOP;
        self.plant.enable(false);
    }

    /// Closes the E-stop line. Error and motors stay as they are.
    pub fn release_estop(&mut self) {
        self.estop_open = false;
        self.estop_until = None;
    }

    /// Goes into error: stops.
    pub fn fail(&mut self, code: u16) {
        self.error = code;
        self.plant.stop();
    }

    /// Everything is as after power-up: motors off, in position mode, no error. The E-stop line stays as it is.
    pub fn restart(&mut self) {
        (self.mode, self.error, self.goal) = (ControlMode::Position, 0, None);
        self.powered_up = self.advanced_to;
        self.plant.enable(false);
    }

    // --- What it reports ---

    /// Number of joints.
    pub fn dof(&self) -> usize {
        self.limits.position_lower.len()
    }

    /// Number of joints that it claims to have: a fault makes it one more.
    pub fn claimed_dof(&mut self) -> usize {
        self.dof() + usize::from(self.take_fault(FaultKind::WrongDof).is_some())
    }

    /// What it measures; faults make it NaN or zero.
    pub fn measured(&mut self) -> Measured {
        let of = |value: f64| {
            let all = [value; MAX_DOF];
            Measured { positions: all, velocities: all, efforts: all }
        };
        if self.take_fault(FaultKind::Nan).is_some() {
            of(f64::NAN)
        } else if self.take_fault(FaultKind::ZeroState).is_some() {
            of(0.0)
        } else {
            let (positions, velocities) = self.joints();
            Measured { positions, velocities, efforts: self.efforts() }
        }
    }

    /// Joint positions [rad] and velocities [rad/s] as they truly are.
    pub fn joints(&self) -> (Joints, Joints) {
        (self.plant.positions(), self.plant.velocities())
    }

    /// Joint torques [Nm] as they truly are.
    pub fn efforts(&self) -> Joints {
        self.plant.efforts()
    }

    /// Up to when it was brought.
    pub fn now(&self) -> Mono {
        self.advanced_to
    }

    /// Time since power-up.
    pub fn uptime(&self) -> Duration {
        self.advanced_to.since(self.powered_up)
    }

    /// Whether all motors are on.
    pub fn enabled(&self) -> bool {
        self.plant.enabled()
    }

    /// Whether the motor of a joint (index from 0) is on.
    pub fn motor(&self, joint: usize) -> bool {
        self.plant.motor(joint)
    }

    /// Whether a joint moves.
    pub fn moving(&self) -> bool {
        self.plant.moving()
    }

    /// The error; 0 = none.
    pub fn error(&self) -> u16 {
        self.error
    }

    /// Whether the E-stop line is open.
    pub fn estop_open(&self) -> bool {
        self.estop_open
    }

    /// The mode.
    pub fn mode(&self) -> ControlMode {
        self.mode
    }
}

/// A pose for power-up: no joint at zero or like another, so that nothing works by accident.
fn pose_of_no_symmetry(limits: &JointLimits) -> Vec<f64> {
    let range = limits.position_lower.iter().zip(&limits.position_upper);
    let part = |i: usize| 0.5 + 0.02 * (i + 1) as f64 * if i.is_multiple_of(2) { 1.0 } else { -1.0 };
    range.enumerate().map(|(i, (lower, upper))| lower + (upper - lower) * part(i).clamp(0.1, 0.9)).collect()
}

#[path = "arm_commands.rs"]
mod commands;
#[path = "arm_faults.rs"]
mod faults;
#[cfg(test)]
#[path = "arm_tests.rs"]
mod tests;
