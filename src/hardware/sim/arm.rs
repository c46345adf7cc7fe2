//! What stands behind an emulated controller, whatever its wire: joints with motors, one mode at a time, an error, an
//! E-stop line, and a script of faults. Everything is in SI units, and time is passed in.

use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::clock::Mono;
use crate::hardware::fit::Misfit;
use crate::hardware::sim::faults::{DEFAULT_STALL, Fault, FaultKind, FaultScript, check_kind, check_script};
use crate::hardware::sim::plant::{Drive, Plant};
use crate::hardware::spec::AdapterResult;
use crate::joint::{ControlMode, JointLimits, Joints};

/// Default of [`SimOptions::lag`] [s].
const LAG: f64 = 0.01;
/// Longest lag that an emulator can have [s].
const LONGEST_LAG: f64 = 0.5;
/// Positions this close to a limit count as inside: numbers on the wire are rounded [rad].
const ROUNDING: f64 = 2e-5;
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

/// What an emulator does: the `sim` part of an arm's options.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SimOptions {
    /// Joint positions at power-up [rad], one per joint; a pose of the arm's own when empty.
    pub initial_positions: Vec<f64>,
    /// How far joints are behind their servo set points, 0 to 0.5 [s].
    #[schemars(range(min = 0, max = 0.5))]
    pub lag: f64,
    /// What goes wrong, and when (seconds after the first connection).
    pub faults: Vec<Fault>,
}

impl Default for SimOptions {
    fn default() -> Self {
        Self { initial_positions: Vec::new(), lag: LAG, faults: Vec::new() }
    }
}

impl SimOptions {
    /// Refuses a pose outside `limits`, a lag that no emulator has, and faults that are not among `playable`. `name` is the arm's.
    pub fn check(&self, name: &str, limits: &JointLimits, playable: &[FaultKind]) -> Result<(), Misfit> {
        check_script(&format!("the {name} emulator"), &self.faults, playable)
            .and_then(|()| check_pose(&self.initial_positions, limits))
            .and_then(|()| check_lag(self.lag))
            .map_err(|misfit| misfit.within("sim"))
    }
}

/// Refuses `initial_positions` [rad] that are neither empty nor a pose within `limits`.
pub fn check_pose(positions: &[f64], limits: &JointLimits) -> Result<(), Misfit> {
    let (dof, given) = (limits.position_lower.len(), positions.len());
    let needed = format!("initial_positions must be {dof} angles [rad] within the joint limits");
    if given != 0 && given != dof {
        return Err(Misfit::new("initial_positions", format!("{needed}, not {given}")));
    }
    let mut range = limits.position_lower.iter().zip(&limits.position_upper).zip(positions).enumerate();
    match range.find(|(_, ((lower, upper), value))| !(**lower..=**upper).contains(value)) {
        None => Ok(()),
        Some((joint, ((lower, upper), value))) => {
            let what = format!("{needed}: joint {} goes from {lower:.4} to {upper:.4}, not to {value}", joint + 1);
            Err(Misfit::new(format!("initial_positions.{joint}"), what))
        }
    }
}

/// Refuses a `lag` [s] that is not 0 to 0.5 s.
pub fn check_lag(lag: f64) -> Result<(), Misfit> {
    if (0.0..=LONGEST_LAG).contains(&lag) {
        Ok(())
    } else {
        Err(Misfit::new("lag", format!("lag must be 0 to {LONGEST_LAG} s, not {lag} s")))
    }
}

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

/// What happens to an answer on its way.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Delivery {
    /// It is sent.
    Send,
    /// It is sent so much later; nobody is served until then.
    Stall(Duration),
    /// It is lost.
    Silent,
    /// Noise goes before it.
    Garbage,
    /// One of its bytes is wrong.
    Corrupt,
    /// Only its first half is sent.
    Truncated,
    /// The connection ends.
    Disconnect,
    /// The connection ends, and there is no power for so long.
    PowerLoss(Duration),
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
}

/// An arm that was just switched on: disabled, in position mode.
pub struct SimArm {
    name: &'static str,
    playable: &'static [FaultKind],
    plant: Plant,
    limits: JointLimits,
    mode: ControlMode,
    error: u16,
    estop_open: bool,
    /// When the E-stop line closes by itself.
    estop_until: Option<Mono>,
    /// In velocity mode the arm stops when no velocity arrives for this long [s].
    velocity_timeout: f64,
    last_velocity: Mono,
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
        let somewhere: Vec<f64>;
        let initial = if options.initial_positions.is_empty() {
            somewhere = pose_of_no_symmetry(limits);
            &somewhere
        } else {
            &options.initial_positions
        };
        Ok(Self {
            name,
            playable,
            plant: Plant::lagging(limits, initial, options.lag),
            limits: limits.clone(),
            mode: ControlMode::Position,
            error: 0,
            estop_open: false,
            estop_until: None,
            velocity_timeout: f64::INFINITY,
            last_velocity: now,
            script: FaultScript::new(&options.faults),
            first_client: None,
            powered_up: now,
            advanced_to: now,
        })
    }

    /// The same arm, that in velocity mode stops when no velocity arrives for so long [s].
    pub fn with_velocity_timeout(mut self, timeout: f64) -> Self {
        self.velocity_timeout = timeout;
        self
    }

    // --- Time and faults ---

    /// Brings the joints up to `now`, and lets the faults of the arm happen that are due. Comes before anything else.
    pub fn advance(&mut self, now: Mono) {
        if self.plant.drive() == Drive::Velocity {
            let timeout = self.last_velocity.seconds_since(self.advanced_to) + self.velocity_timeout;
            if now.seconds_since(self.advanced_to) > timeout {
                self.plant.advance(timeout);
                self.plant.stop();
                self.advanced_to = self.advanced_to.after(Duration::from_secs_f64(timeout.max(0.0)));
            }
        }
        self.plant.advance(now.seconds_since(self.advanced_to).max(0.0));
        self.advanced_to = now.max(self.advanced_to);
        if self.estop_until.is_some_and(|until| now >= until) {
            self.release_estop();
        }
        let t = self.script_time();
        if let Some(fault) = self.script.take(FaultKind::Estop, t) {
            self.press_estop();
            self.estop_until = fault.left(t).map(|left| now.after(left));
        }
        if let Some(fault) = self.script.take(FaultKind::ErrorCode, t) {
            self.error = fault.code;
            self.plant.stop();
        }
        let blocked = self.script.take(FaultKind::Blocked, t).map(|fault| fault.joint.saturating_sub(1));
        (0..self.dof()).for_each(|joint| self.plant.block(joint, blocked == Some(joint)));
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

    /// Lets a fault happen `fault.at` seconds from `now`; an error names the kinds that can be played.
    pub fn inject(&mut self, fault: Fault, now: Mono) -> Result<(), String> {
        check_kind(&format!("the {} emulator", self.name), &fault, self.playable)?;
        let t = self.first_client.map_or(0.0, |first| now.seconds_since(first));
        self.script.inject(fault, t);
        Ok(())
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

    /// Whether a fault of a kind strikes now.
    pub fn struck_by(&mut self, kind: FaultKind) -> Option<Fault> {
        let t = self.script_time();
        self.script.take(kind, t)
    }

    /// What the wire does to the answer that is due now.
    pub fn delivery(&mut self) -> Delivery {
        let t = self.script_time();
        if let Some(fault) = self.struck_by(FaultKind::PowerLoss) {
            let dark = fault.left(t).unwrap_or_default();
            (self.mode, self.error) = (ControlMode::Position, 0);
            self.powered_up = self.advanced_to.after(dark);
            self.plant.enable(false);
            return Delivery::PowerLoss(dark);
        }
        if let Some(fault) = self.struck_by(FaultKind::Stall) {
            return Delivery::Stall(fault.left(t).unwrap_or(DEFAULT_STALL));
        }
        let faults = [
            (FaultKind::Disconnect, Delivery::Disconnect),
            (FaultKind::Silent, Delivery::Silent),
            (FaultKind::Truncated, Delivery::Truncated),
            (FaultKind::Corrupt, Delivery::Corrupt),
            (FaultKind::Garbage, Delivery::Garbage),
        ];
        let struck = faults.iter().find(|(kind, _)| self.struck_by(*kind).is_some());
        struck.map_or(Delivery::Send, |(_, delivery)| *delivery)
    }

    fn script_time(&self) -> f64 {
        self.first_client.map_or(0.0, |first| self.advanced_to.seconds_since(first))
    }

    // --- What it tells ---

    /// Number of joints.
    pub fn dof(&self) -> usize {
        self.limits.position_lower.len()
    }

    /// Number of joints that it claims to have: a fault makes it one more.
    pub fn claimed_dof(&mut self) -> usize {
        self.dof() + usize::from(self.struck_by(FaultKind::WrongDof).is_some())
    }

    /// What it measures; faults make it NaN or zero.
    pub fn measured(&mut self) -> Measured {
        let of = |value: f64| {
            let all = [value; crate::joint::MAX_DOF];
            Measured { positions: all, velocities: all, efforts: all }
        };
        if self.struck_by(FaultKind::Nan).is_some() {
            of(f64::NAN)
        } else if self.struck_by(FaultKind::ZeroState).is_some() {
            of(0.0)
        } else {
            let plant = &self.plant;
            Measured { positions: plant.positions(), velocities: plant.velocities(), efforts: plant.efforts() }
        }
    }

    /// Joint positions as they truly are at `now` [rad].
    pub fn positions_at(&mut self, now: Mono) -> Joints {
        self.advance(now);
        self.plant.positions()
    }

    /// Joint positions [rad] and velocities [rad/s] as they truly are.
    pub fn joints(&self) -> (Joints, Joints) {
        (self.plant.positions(), self.plant.velocities())
    }

    /// Time since power-up.
    pub fn uptime(&self) -> Duration {
        self.advanced_to.since(self.powered_up)
    }

    /// Whether the motors are on.
    pub fn enabled(&self) -> bool {
        self.plant.enabled()
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

    // --- What it is told ---

    /// Changes the mode, at a standstill only.
    pub fn set_mode(&mut self, mode: ControlMode) -> Result<(), Refusal> {
        if mode == self.mode {
            return Ok(());
        }
        if self.plant.moving() {
            return Err(Refusal::Moving);
        }
        self.plant.stop();
        self.mode = mode;
        Ok(())
    }

    /// Switches the motors on, holding where the arm is, or off.
    pub fn enable(&mut self, on: bool) -> Result<(), Refusal> {
        if on && self.error != 0 {
            return Err(Refusal::InError);
        }
        if on
            && !self.plant.enabled()
            && let Some(fault) = self.struck_by(FaultKind::Sag)
        {
            self.plant.sag(fault.amount);
        }
        self.plant.enable(on);
        Ok(())
    }

    /// Clears the error; not while the E-stop line is open.
    pub fn clear_error(&mut self) -> Result<(), Refusal> {
        if self.estop_open {
            return Err(Refusal::InError);
        }
        self.error = 0;
        Ok(())
    }

    /// Decelerates to standstill; the motors stay on.
    pub fn stop(&mut self) {
        self.plant.stop();
    }

    /// Moves to `target` [rad] at a fraction of the top speed, in position mode.
    pub fn move_to(&mut self, target: &[f64], speed: f64) -> Result<(), Refusal> {
        self.may_move(ControlMode::Position)?;
        self.within(target)?;
        self.plant.move_to(target, speed);
        Ok(())
    }

    /// Follows a set point [rad], in servo mode.
    pub fn servo(&mut self, target: &[f64]) -> Result<(), Refusal> {
        self.may_move(ControlMode::ServoPosition)?;
        self.within(target)?;
        self.plant.servo(target);
        Ok(())
    }

    /// Keeps velocities [rad/s], in velocity mode.
    pub fn velocity(&mut self, velocities: &[f64]) -> Result<(), Refusal> {
        self.may_move(ControlMode::Velocity)?;
        self.last_velocity = self.advanced_to;
        self.plant.velocity(velocities);
        Ok(())
    }

    /// Refuses what moves anything while the motors are off or the arm is in error.
    pub fn ready(&self) -> Result<(), Refusal> {
        match (self.error, self.plant.enabled()) {
            (0, true) => Ok(()),
            (0, false) => Err(Refusal::Disabled),
            _ => Err(Refusal::InError),
        }
    }

    /// The same, and what needs a mode that the arm is not in.
    pub fn may_move(&self, mode: ControlMode) -> Result<(), Refusal> {
        self.ready()?;
        if self.mode == mode { Ok(()) } else { Err(Refusal::WrongMode) }
    }

    fn within(&self, target: &[f64]) -> Result<(), Refusal> {
        if inside(target, &self.limits, ROUNDING) { Ok(()) } else { Err(Refusal::OutOfRange) }
    }
}

fn inside(values: &[f64], limits: &JointLimits, margin: f64) -> bool {
    let range = limits.position_lower.iter().zip(&limits.position_upper);
    values.iter().zip(range).all(|(value, (lower, upper))| (lower - margin..=upper + margin).contains(value))
}

/// A pose for power-up: no joint at zero or like another, so that nothing works by accident.
fn pose_of_no_symmetry(limits: &JointLimits) -> Vec<f64> {
    let range = limits.position_lower.iter().zip(&limits.position_upper);
    let part = |i: usize| 0.5 + 0.02 * (i + 1) as f64 * if i.is_multiple_of(2) { 1.0 } else { -1.0 };
    range.enumerate().map(|(i, (lower, upper))| lower + (upper - lower) * part(i).clamp(0.1, 0.9)).collect()
}
