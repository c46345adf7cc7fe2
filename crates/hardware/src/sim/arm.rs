//! Simulated arm behind an emulated controller, independent of the transport: joints with motors, one mode at a time,
//! an error, an E-stop line, and a fault script. All values are in SI units, and time is passed in.

use std::time::Duration;

pub use super::delivery::Delivery;
use super::misreading::Memory;
pub use super::options::{ControllerOptions, SimOptions, check_pose, check_range};
use crate::adapter::AdapterResult;
use crate::registry::Truth;
use crate::sim::faults::{FaultKind, FaultScript, joined};
use crate::sim::physics::Body;
use crate::sim::plant::{Drive, Plant};
use crate::sim::weight::Masses;
use dimos_core::arm::Setpoint;
use dimos_core::clock::Mono;
use dimos_core::joint::{ControlMode, JointLimits, Joints, MAX_DOF};

/// Positions this close to a limit count as inside: values on the wire are rounded [rad].
const ROUNDING: f64 = 2e-5;
/// Consecutive goals of a servo closer than this in time and position are a stream [s, rad].
const STREAM: (f64, f64) = (0.1, 0.1);
/// Error code of the open E-stop line.
pub const ESTOP: u16 = 1;

/// The faults that a [`SimArm`] can play on a byte stream: those of the arm and those of [`SimArm::delivery`]. The
/// controller itself plays `WrongModel` and `Frozen`.
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
    FaultKind::WrongModel,
    FaultKind::Misread,
    FaultKind::Frozen,
    FaultKind::Sag,
    FaultKind::Blocked,
    FaultKind::Pushed,
    FaultKind::Nudged,
    FaultKind::MotorOff,
];

/// Returns [`PLAYABLE`] and more kinds; `N` is how many all are.
pub const fn playable_and<const N: usize>(more: &[FaultKind]) -> [FaultKind; N] {
    joined(PLAYABLE, more)
}

/// Why the arm refuses a command.
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

/// Measurements of an arm: joint positions [rad], velocities [rad/s], torques [Nm].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured {
    /// Joint positions [rad].
    pub positions: Joints,
    /// Joint velocities [rad/s].
    pub velocities: Joints,
    /// Joint torques [Nm].
    pub efforts: Joints,
}

/// An emulated controller with a simulated arm, as its server needs it.
pub trait HasArm {
    /// The arm.
    fn arm(&mut self) -> &mut SimArm;

    /// Advances everything to `now`: the arm, and other moving parts of the controller.
    fn advance(&mut self, now: Mono) {
        self.arm().advance(now);
    }

    /// Returns the time of the arm at `now`: another one where the controller's clock starts the cycles.
    fn time(&self, now: Mono) -> Mono {
        now
    }

    /// Returns the true joint positions [rad] and velocities [rad/s] at `now`.
    fn joints_at(&mut self, now: Mono) -> (Joints, Joints) {
        self.advance(now);
        self.arm().joints()
    }

    /// Returns what is true at `now`. A controller does not replace this; what more it knows it adds in
    /// [`HasArm::complete`].
    fn truth(&mut self, now: Mono) -> Truth {
        let (positions, _) = self.joints_at(now);
        let arm = self.arm();
        let mut truth = Truth {
            positions: Some(positions),
            motors_on: Some(arm.enabled()),
            motor_switches: Some(arm.switches()),
            temperatures: Some(std::array::from_fn(SimArm::temperature)),
            efforts: Some(arm.efforts()),
            setpoint: arm.setpoint(),
            ..Truth::default()
        };
        self.complete(&mut truth);
        truth
    }

    /// Adds what only the controller knows: its gripper, drives with other temperatures.
    fn complete(&self, _truth: &mut Truth) {}
}

/// A simulated arm. Initially disabled, in position mode.
pub struct SimArm {
    name: &'static str,
    playable: &'static [FaultKind],
    plant: Plant,
    /// Its body, if it has mass; the plant is then where the controller commands it to be.
    body: Option<Body>,
    /// The error when a joint of the body does not follow.
    collision: Option<u16>,
    limits: JointLimits,
    /// How far outside its limits a target may be [rad].
    tolerance: f64,
    mode: ControlMode,
    /// Whether the arm has modes. Without modes it takes any command at any time.
    has_modes: bool,
    error: u16,
    /// The joint whose drive is in error (index from 0).
    faulty: usize,
    /// How often a motor was switched on or off.
    switches: u32,
    estop_open: bool,
    /// When the E-stop line closes.
    estop_until: Option<Mono>,
    /// In velocity mode the arm stops when no velocity arrives within this time.
    velocity_timeout: Option<Duration>,
    velocity_until: Option<Mono>,
    /// The goal of a servo [rad], and when it arrived.
    goal: Option<(Joints, Mono)>,
    /// The last setpoint of [`SimArm::follow`], and until when it holds in impedance mode.
    setpoint: Option<Setpoint>,
    setpoint_until: Option<Mono>,
    script: FaultScript,
    misreadings: Memory,
    /// Whether setpoints are reported instead of measurements.
    reports_commanded: bool,
    /// Time zero of the fault script.
    first_client: Option<Mono>,
    powered_up: Mono,
    advanced_to: Mono,
}

impl SimArm {
    /// Creates an arm within `limits`. Returns an error for invalid options. `playable` are the faults that its
    /// controller can play, `name` is the name of the adapter.
    pub fn new(
        name: &'static str,
        limits: &JointLimits,
        options: &SimOptions,
        playable: &'static [FaultKind],
        now: Mono,
    ) -> AdapterResult<Self> {
        options.check(name, limits, playable)?;
        let options = options.clone().starting_at(&asymmetric_pose(limits));
        let mut plant = Plant::lagging(limits, &options.initial_positions, options.lag)
            .drooping(options.droop)
            .as_controlled(options.controller.deceleration, options.controller.gap_tolerance);
        let started = |physics| Body::start(physics, &options.initial_positions, options.droop);
        let body = options.physics.as_ref().map(started).transpose()?;
        if body.is_some() {
            plant.as_reference();
        }
        Ok(Self {
            name,
            playable,
            plant,
            body,
            collision: None,
            limits: limits.clone(),
            tolerance: ROUNDING,
            mode: ControlMode::Position,
            has_modes: true,
            error: 0,
            faulty: 0,
            switches: 0,
            estop_open: false,
            estop_until: None,
            velocity_timeout: None,
            velocity_until: None,
            goal: None,
            setpoint: None,
            setpoint_until: None,
            script: FaultScript::new(&options.faults),
            misreadings: Memory::default(),
            reports_commanded: options.controller.reports_commanded,
            first_client: None,
            powered_up: now,
            advanced_to: now,
        })
    }

    /// Replaces the joints.
    pub fn with_plant(mut self, plant: Plant) -> Self {
        self.plant = plant;
        self
    }

    /// Gives the joints masses.
    pub fn with_masses(mut self, masses: Masses) -> Self {
        if self.body.is_none() {
            self.plant = self.plant.with_masses(masses);
        }
        self
    }

    /// Stops the arm in velocity mode when no velocity arrives within `timeout` [s].
    pub fn with_velocity_timeout(mut self, timeout: f64) -> Self {
        self.velocity_timeout = Some(Duration::from_secs_f64(timeout));
        self
    }

    /// Sets the error of a joint that does not follow because something is in its way.
    pub fn colliding_as(mut self, error: u16) -> Self {
        self.collision = Some(error);
        self
    }

    /// Accepts targets up to `tolerance` [rad] outside the limits. Joints never leave their limits.
    pub fn with_tolerance(mut self, tolerance: f64) -> Self {
        self.tolerance = tolerance;
        self
    }

    /// Removes the modes: the arm takes targets, setpoints and velocities at any time, as servos do.
    pub fn without_modes(mut self) -> Self {
        self.has_modes = false;
        self
    }

    /// Lets joints whose motors are off fall at `speed` [rad/s], each to its position in `rest` [rad]; a joint without
    /// one stays where it is. Before this call, brakes or supports hold the arm.
    pub fn falls(&mut self, speed: f64, rest: &[Option<f64>]) {
        match &mut self.body {
            Some(body) => body.falls = speed > 0.0,
            None => self.plant.falls(speed, rest),
        }
    }

    /// Lets only the first joints droop: a gripper after them carries no load.
    pub fn load(&mut self, joints: usize) {
        self.plant.load(joints);
    }

    // --- Time, power and clients ---

    /// Advances the joints to `now` and plays the arm's faults that are due. Call it before anything else.
    pub fn advance(&mut self, now: Mono) {
        self.integrate(now);
        self.apply_faults();
    }

    /// Advances the joints to `now`, without faults.
    pub fn integrate(&mut self, now: Mono) {
        if let Some(until) = self.velocity_until.filter(|until| *until < now) {
            self.pass(until);
            self.velocity_until = None;
            if self.plant.drive() == Drive::Velocity {
                self.plant.stop();
            }
        }
        if let Some(until) = self.setpoint_until.filter(|until| *until < now) {
            self.pass(until);
            self.setpoint_until = None;
            if self.plant.drive() == Drive::Compliant {
                self.plant.stop();
            }
        }
        self.pass(now);
        if self.estop_until.is_some_and(|until| now >= until) {
            self.release_estop();
        }
    }

    fn pass(&mut self, to: Mono) {
        let dt = to.seconds_since(self.advanced_to).max(0.0);
        self.advanced_to = to.max(self.advanced_to);
        let Some(body) = &mut self.body else { return self.plant.advance(dt) };
        body.advance(&mut self.plant, dt);
        if let Some((joint, code)) = body.take_blocked().zip(self.collision).filter(|_| self.error == 0) {
            // It holds where it was stopped, not where it was to go.
            (0..self.limits.position_lower.len()).for_each(|joint| {
                let at = self.body.as_ref().and_then(|body| body.joint(joint));
                at.into_iter().for_each(|(q, v, _)| self.plant.place(joint, q, v));
            });
            self.plant.come_to_rest();
            self.fail_joint(joint, code);
        }
    }

    /// A client has connected. The first connection is time zero of the script.
    pub fn client_came(&mut self) {
        self.first_client.get_or_insert(self.advanced_to);
    }

    /// The client has disconnected: the arm stops.
    pub fn client_gone(&mut self, now: Mono) {
        self.advance(now);
        self.plant.stop();
    }

    /// Opens the E-stop line: sets the error and disables the motors.
    pub fn press_estop(&mut self) {
        self.estop_open = true;
        self.estop_until = None;
        self.error = ESTOP;
        self.switch_off();
    }

    /// Closes the E-stop line. Error and motors do not change.
    pub fn release_estop(&mut self) {
        self.estop_open = false;
        self.estop_until = None;
    }

    /// Sets an error and stops the arm. If its drives have errors of their own, the first one is in error.
    pub fn fail(&mut self, code: u16) {
        self.fail_joint(0, code);
    }

    /// Sets an error of a joint (index from 0) and stops the arm.
    pub fn fail_joint(&mut self, joint: usize, code: u16) {
        (self.error, self.faulty) = (code, joint);
        self.plant.stop();
    }

    /// Resets the arm to its state at power-up: motors off, position mode, no error. The E-stop line does not change.
    pub fn restart(&mut self) {
        (self.mode, self.error, self.goal) = (ControlMode::Position, 0, None);
        self.powered_up = self.advanced_to;
        self.switch_off();
    }

    // --- State ---

    /// Returns the number of joints.
    pub fn dof(&self) -> usize {
        self.limits.position_lower.len()
    }

    /// Returns the number of joints that the arm reports: one more during a fault.
    pub fn claimed_dof(&mut self) -> usize {
        self.dof() + usize::from(self.take_fault(FaultKind::WrongDof).is_some())
    }

    /// Returns the measurements; faults make them NaN, zero or otherwise wrong.
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
            let (mut positions, mut velocities) = self.joints();
            self.misread(&mut positions, &mut velocities);
            Measured { positions, velocities, efforts: self.efforts() }
        }
    }

    /// Returns the true joint positions [rad] and velocities [rad/s].
    pub fn joints(&self) -> (Joints, Joints) {
        let (mut positions, mut velocities) = (self.plant.positions(), self.plant.velocities());
        for (joint, (q, v)) in positions.iter_mut().zip(&mut velocities).enumerate() {
            if let Some((position, velocity, _)) = self.body.as_ref().and_then(|body| body.joint(joint)) {
                (*q, *v) = (position, velocity);
            }
        }
        (positions, velocities)
    }

    /// Returns the true joint torques [Nm].
    pub fn efforts(&self) -> Joints {
        let mut efforts = self.plant.efforts();
        for (joint, out) in efforts.iter_mut().enumerate() {
            if let Some((_, _, effort)) = self.body.as_ref().and_then(|body| body.joint(joint)) {
                *out = effort;
            }
        }
        efforts
    }

    /// Returns the last setpoint of [`SimArm::follow`].
    pub fn setpoint(&self) -> Option<Setpoint> {
        self.setpoint
    }

    /// Returns the time up to which the arm was advanced.
    pub fn now(&self) -> Mono {
        self.advanced_to
    }

    /// Returns the time since power-up.
    pub fn uptime(&self) -> Duration {
        self.advanced_to.since(self.powered_up)
    }

    /// Returns whether all motors are on.
    pub fn enabled(&self) -> bool {
        self.plant.enabled()
    }

    /// Returns whether the motor of a joint (index from 0) is on.
    pub fn motor(&self, joint: usize) -> bool {
        self.plant.motor(joint)
    }

    /// Returns whether any joint moves.
    pub fn moving(&self) -> bool {
        self.plant.moving()
    }

    /// Returns the error code; 0 = none.
    pub fn error(&self) -> u16 {
        self.error
    }

    /// Returns the error code of the drive of a joint (index from 0); 0 = none.
    pub fn error_of(&self, joint: usize) -> u16 {
        if joint == self.faulty { self.error } else { 0 }
    }

    /// Returns how often a motor was switched on or off.
    pub fn switches(&self) -> u32 {
        self.switches
    }

    /// Returns the temperature of the drive of a joint (index from 0) without load [°C]: no two are equal, so that
    /// mistakes show.
    pub fn temperature(joint: usize) -> f64 {
        31.0 + joint as f64
    }

    /// Returns whether the E-stop line is open.
    pub fn estop_open(&self) -> bool {
        self.estop_open
    }

    /// Returns the mode.
    pub fn mode(&self) -> ControlMode {
        self.mode
    }
}

/// Returns the default pose at power-up: no joint at zero or equal to another one, so that mistakes show.
fn asymmetric_pose(limits: &JointLimits) -> Vec<f64> {
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
