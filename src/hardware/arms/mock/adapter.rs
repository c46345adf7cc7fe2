//! The mock arm behind the adapter protocol. There is no wire, so there are no units to convert: what would be the
//! controller is a plant that is brought up to date with the clock at every call.

use std::sync::Arc;
use std::time::Duration;

use super::options::Options;
use super::{MODES, NATIVE_RATE, limits};
use crate::clock::{Clock, Mono, MonotonicClock};
use crate::hardware::registry::AdapterConfig;
use crate::hardware::sim::faults::{Fault, FaultKind, FaultScript};
use crate::hardware::sim::plant::{Drive, Gripper, Plant, Tracking};
use crate::hardware::spec::{
    AdapterError, AdapterResult, JointReading, ManipulatorAdapter, ManipulatorInfo, RobotState, Stop,
};
use crate::joint::{ControlMode, JointLimits, Joints, MAX_DOF};

/// Widest opening [m] and speed [m/s] of the gripper.
const GRIPPER: (f64, f64) = (0.08, 0.1);
/// How fast an arm without brakes sinks while disabled [rad/s].
const FALL_SPEED: f64 = 0.2;
/// Error code of the open E-stop line.
const ESTOP: u16 = 1;

/// An ideal arm in memory.
pub struct MockArm {
    options: Options,
    dof: usize,
    clock: Arc<dyn Clock>,
    plant: Plant,
    gripper: Gripper,
    mode: ControlMode,
    connected: bool,
    error: u16,
    /// The E-stop line is open until then.
    estop_until: Mono,
    /// There is no power until then.
    power_off_until: Mono,
    script: FaultScript,
    /// When the first connection was made: time zero of the script.
    first_connection: Option<Mono>,
    advanced_to: Mono,
}

impl MockArm {
    /// A mock arm on the monotonic clock.
    pub fn new(config: &AdapterConfig) -> AdapterResult<Self> {
        Self::with_clock(config, Arc::new(MonotonicClock))
    }

    /// A mock arm on another clock, for tests. Latency and stalls block in real time all the same.
    pub fn with_clock(config: &AdapterConfig, clock: Arc<dyn Clock>) -> AdapterResult<Self> {
        let options: Options = config.options()?;
        let dof = config.dof;
        let rejected = |text| AdapterError::Rejected(format!("{}: {text}", config.hardware_id));
        if !(1..=MAX_DOF).contains(&dof) {
            return Err(rejected(format!("a mock arm has 1 to {MAX_DOF} joints, not {dof}")));
        }
        options.check(dof).map_err(rejected)?;
        let tracking = if options.lag > 0.0 { Tracking::Lag(options.lag) } else { Tracking::Ideal };
        let fall = if options.brakes { 0.0 } else { FALL_SPEED };
        let advanced_to = clock.now();
        Ok(Self {
            dof,
            plant: Plant::new(&limits(dof), &options.initial_positions, tracking, fall),
            gripper: Gripper::new(GRIPPER.0, GRIPPER.1),
            mode: ControlMode::Position,
            connected: false,
            error: 0,
            estop_until: Mono::ZERO,
            power_off_until: Mono::ZERO,
            script: FaultScript::new(&options.faults),
            first_connection: None,
            advanced_to,
            clock,
            options,
        })
    }

    /// Lets a fault happen `fault.at` seconds from now.
    pub fn inject(&mut self, fault: Fault) {
        let now = self.script_time();
        self.script.inject(fault, now);
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

    /// The part of an answer that needs no exchange with the arm, as if it had come with the last joint positions.
    fn answer(&mut self) -> AdapterResult<()> {
        if !self.connected {
            return Err(AdapterError::NotConnected);
        }
        self.advance();
        Ok(())
    }

    /// What every write and every read of the joints begins with: it takes its time, and suffers the faults that
    /// are due.
    fn exchange(&mut self) -> AdapterResult<()> {
        self.answer()?;
        if self.options.latency_ms > 0.0 {
            std::thread::sleep(Duration::from_secs_f64(self.options.latency_ms * 1e-3));
        }
        let now = self.script_time();
        if let Some(stall) = self.script.take(FaultKind::Stall, now) {
            let left = stall.end().map_or(1.0, |end| end - now);
            std::thread::sleep(Duration::from_secs_f64(left.max(0.0)));
        }
        self.advance();
        if self.script.take(FaultKind::Panic, now).is_some() {
            panic!("scripted fault: the adapter panics");
        }
        if self.script.take(FaultKind::Disconnect, now).is_some() {
            self.connected = false;
            self.plant.stop();
            return Err(AdapterError::Io("connection closed (scripted fault)".into()));
        }
        if let Some(loss) = self.script.take(FaultKind::PowerLoss, now) {
            self.power_off_until = self.clock.now().after(Duration::from_secs_f64(loss.duration));
            self.connected = false;
            self.plant.enable(false);
            return Err(AdapterError::Io("connection closed (scripted loss of power)".into()));
        }
        if let Some(estop) = self.script.take(FaultKind::Estop, now) {
            self.estop_until = self.clock.now().after(Duration::from_secs_f64(estop.duration));
            self.error = ESTOP;
            self.plant.enable(false);
        }
        if let Some(fault) = self.script.take(FaultKind::ErrorCode, now) {
            self.error = fault.code;
            self.plant.stop();
        }
        for joint in 0..self.dof {
            self.plant.block(joint, false);
        }
        if let Some(fault) = self.script.take(FaultKind::Blocked, now) {
            self.plant.block(fault.joint.saturating_sub(1), true);
        }
        Ok(())
    }

    fn read(&mut self) -> AdapterResult<()> {
        self.exchange()?;
        let now = self.script_time();
        match self.script.take(FaultKind::ReadError, now) {
            None => Ok(()),
            Some(_) => Err(AdapterError::Io("read failed (scripted fault)".into())),
        }
    }

    fn write(&mut self) -> AdapterResult<()> {
        self.exchange()?;
        let now = self.script_time();
        match self.script.take(FaultKind::WriteError, now) {
            None => Ok(()),
            Some(_) => Err(AdapterError::Io("write failed (scripted fault)".into())),
        }
    }

    /// A write of motion: needs the motors on and no error.
    fn write_motion(&mut self) -> AdapterResult<()> {
        self.write()?;
        if self.error != 0 {
            Err(AdapterError::Fault { code: self.error.into(), text: error_text(self.error) })
        } else if !self.plant.enabled() {
            Err(AdapterError::Rejected("the motors are disabled".into()))
        } else {
            Ok(())
        }
    }

    fn check_joints(&self, values: &[f64]) -> AdapterResult<()> {
        if values.len() == self.dof && values.iter().all(|value| value.is_finite()) {
            Ok(())
        } else {
            Err(AdapterError::Rejected(format!("{} finite values are needed, one per joint", self.dof)))
        }
    }

    /// Joint values as reported: as they are, or spoiled by a fault.
    fn reported(&mut self, values: Joints) -> Joints {
        let now = self.script_time();
        if self.script.take(FaultKind::Nan, now).is_some() {
            [f64::NAN; MAX_DOF]
        } else if self.script.take(FaultKind::ZeroState, now).is_some() {
            [0.0; MAX_DOF]
        } else {
            values
        }
    }
}

fn error_text(code: u16) -> String {
    if code == ESTOP { "E-stop line open".to_owned() } else { format!("scripted error {code}") }
}

/// The first dof values of `from`, the rest zero; `into` has length dof.
fn fill(into: &mut [f64], from: &Joints) {
    for (to, value) in into.iter_mut().zip(from) {
        *to = *value;
    }
}

impl ManipulatorAdapter for MockArm {
    fn connect(&mut self) -> AdapterResult<()> {
        let now = self.clock.now();
        if now < self.power_off_until {
            return Err(AdapterError::Io("cannot connect to the mock arm: it has no power (scripted fault)".into()));
        }
        self.first_connection.get_or_insert(now);
        let script_time = self.script_time();
        if self.script.take(FaultKind::WrongDof, script_time).is_some() {
            let (expected, found) = (self.dof, self.dof + 1);
            return Err(AdapterError::Rejected(format!("expected {expected} joints, the arm says {found}")));
        }
        self.advance();
        self.connected = true;
        Ok(())
    }

    fn disconnect(&mut self) {
        self.connected = false;
    }

    fn is_connected(&self) -> bool {
        self.connected
    }

    fn get_info(&self) -> ManipulatorInfo {
        ManipulatorInfo {
            vendor: "dimos".into(),
            model: "mock".into(),
            dof: self.dof,
            firmware_version: None,
            serial_number: None,
            native_rate: NATIVE_RATE,
            modes: MODES,
            holds_when_disabled: self.options.brakes,
            whole_state_at_once: true,
        }
    }

    fn get_dof(&self) -> usize {
        self.dof
    }

    fn get_limits(&mut self) -> AdapterResult<JointLimits> {
        Ok(limits(self.dof))
    }

    fn set_control_mode(&mut self, mode: ControlMode) -> AdapterResult<()> {
        if !MODES.contains(&mode) {
            return Err(AdapterError::Unsupported);
        }
        self.write()?;
        if mode != self.mode {
            if self.plant.moving() {
                return Err(AdapterError::Rejected("the mode cannot change while the arm moves".into()));
            }
            self.plant.stop();
            self.mode = mode;
        }
        Ok(())
    }

    fn get_control_mode(&self) -> ControlMode {
        self.mode
    }

    fn read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()> {
        self.read()?;
        let values = self.reported(self.plant.positions());
        fill(positions, &values);
        Ok(())
    }

    fn read_joint_velocities(&mut self, velocities: &mut [f64]) -> AdapterResult<bool> {
        self.answer()?;
        fill(velocities, &self.plant.velocities());
        Ok(self.options.velocity_feedback)
    }

    fn read_joint_efforts(&mut self, efforts: &mut [f64]) -> AdapterResult<bool> {
        self.answer()?;
        fill(efforts, &self.plant.efforts());
        Ok(self.options.effort_feedback)
    }

    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        self.read()?;
        let zero = [0.0; MAX_DOF];
        let position = self.reported(self.plant.positions());
        // Entries past dof stay zero, also when the others are NaN.
        reading.position = zero;
        fill(reading.position.get_mut(..self.dof).unwrap_or_default(), &position);
        reading.velocity = self.options.velocity_feedback.then(|| self.plant.velocities());
        reading.effort = self.options.effort_feedback.then(|| self.plant.efforts());
        reading.stamp = Some(self.advanced_to);
        Ok(())
    }

    fn read_state(&mut self) -> AdapterResult<RobotState> {
        self.answer()?;
        let state = match (self.error, self.plant.drive()) {
            (0, Drive::Disabled) => 0,
            (0, _) if self.plant.moving() => 2,
            (0, _) => 1,
            _ => 3,
        };
        let mode = MODES.iter().position(|mode| *mode == self.mode).unwrap_or_default();
        Ok(RobotState { state, mode: mode as i32 })
    }

    fn read_error(&mut self) -> AdapterResult<(i32, String)> {
        self.answer()?;
        if self.error == 0 { Ok((0, String::new())) } else { Ok((self.error.into(), error_text(self.error))) }
    }

    fn read_enabled(&mut self) -> AdapterResult<bool> {
        self.answer()?;
        Ok(self.plant.enabled())
    }

    fn write_joint_positions(&mut self, positions: &[f64], velocity: f64) -> AdapterResult<()> {
        self.check_joints(positions)?;
        self.write_motion()?;
        match self.mode {
            ControlMode::Position => self.plant.move_to(positions, velocity),
            ControlMode::ServoPosition => self.plant.servo(positions),
            _ => return Err(AdapterError::Rejected("joint positions in velocity mode".into())),
        }
        Ok(())
    }

    fn write_joint_velocities(&mut self, velocities: &[f64]) -> AdapterResult<()> {
        self.check_joints(velocities)?;
        self.write_motion()?;
        if self.mode != ControlMode::Velocity {
            return Err(AdapterError::Rejected(format!("joint velocities in {} mode", self.mode.name())));
        }
        self.plant.velocity(velocities);
        Ok(())
    }

    fn write_stop(&mut self) -> AdapterResult<Stop> {
        self.write()?;
        self.plant.stop();
        self.gripper.stop();
        Ok(Stop::Confirmed)
    }

    fn write_enable(&mut self, enable: bool) -> AdapterResult<()> {
        self.write()?;
        if enable && self.error != 0 {
            return Err(AdapterError::Fault { code: self.error.into(), text: error_text(self.error) });
        }
        let now = self.script_time();
        if enable && !self.plant.enabled() {
            self.plant.enable(true);
            if let Some(fault) = self.script.take(FaultKind::Sag, now) {
                self.plant.sag(fault.amount);
            }
        }
        self.plant.enable(enable);
        Ok(())
    }

    fn write_clear_errors(&mut self) -> AdapterResult<()> {
        self.write()?;
        if self.clock.now() < self.estop_until {
            return Err(AdapterError::Fault { code: ESTOP.into(), text: error_text(ESTOP) });
        }
        self.error = 0;
        Ok(())
    }

    fn read_gripper_position(&mut self) -> AdapterResult<Option<f64>> {
        self.answer()?;
        Ok(self.options.gripper.then_some(self.gripper.position))
    }

    fn write_gripper_position(&mut self, position: f64) -> AdapterResult<()> {
        if !self.options.gripper {
            return Err(AdapterError::Unsupported);
        }
        self.write_motion()?;
        if !(0.0..=GRIPPER.0).contains(&position) {
            return Err(AdapterError::Rejected(format!(
                "gripper opening {position} m is not within 0 to {} m",
                GRIPPER.0
            )));
        }
        self.gripper.move_to(position);
        Ok(())
    }

    fn read_force_torque(&mut self) -> AdapterResult<Option<[f64; 6]>> {
        self.answer()?;
        Ok(self.options.force_torque.then_some([0.0; 6]))
    }
}
