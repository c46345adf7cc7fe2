//! What would be the mock arm's controller: a plant that is brought up to date with the clock at every call, and
//! the script of its faults.

use std::sync::Arc;
use std::time::Duration;

use super::limits;
use super::options::Options;
use crate::clock::{Clock, Mono};
use crate::hardware::sim::faults::{DEFAULT_STALL, Fault, FaultKind, FaultScript};
use crate::hardware::sim::gripper::Gripper;
use crate::hardware::sim::plant::{Plant, Tracking};
use crate::hardware::spec::{AdapterError, AdapterResult};
use crate::joint::{Joints, MAX_DOF};

/// Widest opening of the gripper [m].
pub const GRIPPER_MAX: f64 = 0.08;
/// Speed of the gripper [m/s].
const GRIPPER_SPEED: f64 = 0.1;
/// How fast an arm without brakes sinks while disabled [rad/s].
const FALL_SPEED: f64 = 0.2;
/// Error code of the open E-stop line.
const ESTOP: u16 = 1;
/// A time that never comes.
const NEVER: Mono = Mono(u64::MAX);

/// The simulated arm behind the adapter.
pub struct Device {
    pub plant: Plant,
    pub gripper: Gripper,
    pub connected: bool,
    /// Error code; 0 = none.
    pub error: u16,
    /// Up to when plant and gripper have moved.
    pub advanced_to: Mono,
    dof: usize,
    clock: Arc<dyn Clock>,
    latency: Duration,
    /// The E-stop line is open until then.
    estop_until: Mono,
    /// There is no power until then.
    power_off_until: Mono,
    script: FaultScript,
    /// When the first connection was made: time zero of the script.
    first_connection: Option<Mono>,
}

impl Device {
    /// An arm of `dof` joints that was just switched on.
    pub fn new(dof: usize, options: &Options, clock: Arc<dyn Clock>) -> Self {
        let tracking = if options.lag > 0.0 { Tracking::Lag(options.lag) } else { Tracking::Ideal };
        let fall = if options.brakes { 0.0 } else { FALL_SPEED };
        Self {
            plant: Plant::new(&limits(dof), &options.initial_positions, tracking, fall),
            gripper: Gripper::new(GRIPPER_MAX, GRIPPER_SPEED),
            connected: false,
            error: 0,
            advanced_to: clock.now(),
            dof,
            clock,
            latency: Duration::from_secs_f64(options.latency_ms * 1e-3),
            estop_until: Mono::ZERO,
            power_off_until: Mono::ZERO,
            script: FaultScript::new(&options.faults),
            first_connection: None,
        }
    }

    pub fn inject(&mut self, fault: Fault) {
        let now = self.script_time();
        self.script.inject(fault, now);
    }

    /// The fault of this kind that strikes now.
    pub fn strikes(&mut self, kind: FaultKind) -> Option<Fault> {
        let now = self.script_time();
        self.script.take(kind, now)
    }

    pub fn connect(&mut self) -> AdapterResult<()> {
        let now = self.clock.now();
        if now < self.power_off_until {
            return Err(AdapterError::Io("cannot connect to the mock arm: it has no power (scripted fault)".into()));
        }
        self.first_connection.get_or_insert(now);
        if self.strikes(FaultKind::WrongDof).is_some() {
            let (expected, found) = (self.dof, self.dof + 1);
            return Err(AdapterError::Rejected(format!("expected {expected} joints, the arm says {found}")));
        }
        self.advance();
        self.connected = true;
        Ok(())
    }

    /// The arm stops when its connection ends, as one with a controller does.
    pub fn disconnect(&mut self) {
        if self.connected {
            self.advance();
            self.plant.stop();
            self.connected = false;
        }
    }

    /// A part of an answer that needs no exchange with the arm, as if it had come with the last joint positions.
    pub fn answer(&mut self) -> AdapterResult<()> {
        if !self.connected {
            return Err(AdapterError::NotConnected);
        }
        self.advance();
        Ok(())
    }

    /// What a read of the joints begins with.
    pub fn read(&mut self) -> AdapterResult<()> {
        self.exchange()?;
        match self.strikes(FaultKind::ReadError) {
            None => Ok(()),
            Some(_) => Err(AdapterError::Io("read failed (scripted fault)".into())),
        }
    }

    /// What a write begins with.
    pub fn write(&mut self) -> AdapterResult<()> {
        self.exchange()?;
        match self.strikes(FaultKind::WriteError) {
            None => Ok(()),
            Some(_) => Err(AdapterError::Io("write failed (scripted fault)".into())),
        }
    }

    /// What a write of motion begins with: it needs the motors on and no error.
    pub fn write_motion(&mut self) -> AdapterResult<()> {
        self.write()?;
        if self.error != 0 {
            Err(self.fault())
        } else if !self.plant.enabled() {
            Err(AdapterError::Rejected("the motors are disabled".into()))
        } else {
            Ok(())
        }
    }

    /// Joint positions as reported: as they are, or spoiled by a fault.
    pub fn reported_positions(&mut self) -> Joints {
        if self.strikes(FaultKind::Nan).is_some() {
            [f64::NAN; MAX_DOF]
        } else if self.strikes(FaultKind::ZeroState).is_some() {
            [0.0; MAX_DOF]
        } else {
            self.plant.positions()
        }
    }

    pub fn clear_error(&mut self) -> AdapterResult<()> {
        if self.clock.now() < self.estop_until {
            return Err(self.fault());
        }
        self.error = 0;
        Ok(())
    }

    /// The error as the answer to a command that it forbids.
    pub fn fault(&self) -> AdapterError {
        AdapterError::Fault { code: self.error.into(), text: self.error_text() }
    }

    /// What the error means; empty when there is none.
    pub fn error_text(&self) -> String {
        match self.error {
            0 => String::new(),
            ESTOP => "E-stop line open".to_owned(),
            code => format!("scripted error {code}"),
        }
    }

    fn script_time(&self) -> f64 {
        self.first_connection.map_or(0.0, |first| self.clock.now().seconds_since(first))
    }

    /// Brings joints and gripper up to the present.
    fn advance(&mut self) {
        let now = self.clock.now();
        let dt = now.seconds_since(self.advanced_to).max(0.0);
        self.advanced_to = now;
        self.plant.advance(dt);
        self.gripper.advance(dt);
    }

    /// An exchange with the arm: it takes its time, and suffers the faults that are due.
    fn exchange(&mut self) -> AdapterResult<()> {
        self.answer()?;
        if !self.latency.is_zero() {
            std::thread::sleep(self.latency);
        }
        let now = self.script_time();
        if let Some(stall) = self.script.take(FaultKind::Stall, now) {
            std::thread::sleep(stall.left(now).unwrap_or(DEFAULT_STALL));
        }
        self.advance();
        if self.script.take(FaultKind::Panic, now).is_some() {
            panic!("scripted fault: the adapter panics");
        }
        if self.script.take(FaultKind::Disconnect, now).is_some() {
            self.disconnect();
            return Err(AdapterError::Io("connection closed (scripted fault)".into()));
        }
        if let Some(loss) = self.script.take(FaultKind::PowerLoss, now) {
            self.power_off_until = self.clock.now().after(loss.left(now).unwrap_or_default());
            self.connected = false;
            self.error = 0;
            self.plant.enable(false);
            return Err(AdapterError::Io("connection closed (scripted loss of power)".into()));
        }
        if let Some(estop) = self.script.take(FaultKind::Estop, now) {
            self.estop_until = estop.left(now).map_or(NEVER, |left| self.clock.now().after(left));
            self.error = ESTOP;
            self.plant.enable(false);
        }
        if let Some(fault) = self.script.take(FaultKind::ErrorCode, now) {
            self.error = fault.code;
            self.plant.stop();
        }
        let blocked = self.script.take(FaultKind::Blocked, now).map(|fault| fault.joint.saturating_sub(1));
        (0..self.dof).for_each(|joint| self.plant.block(joint, blocked == Some(joint)));
        Ok(())
    }
}
