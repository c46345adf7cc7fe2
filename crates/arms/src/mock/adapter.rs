//! The mock arm behind the adapter protocol. There is no wire, so there are no units to convert.

use std::sync::Arc;

use super::device::{Device, GRIPPER_DEFAULT_FORCE, GRIPPER_FORCE, GRIPPER_MAX};
use super::options::Options;
use super::{MODES, NATIVE_RATE, check, limits};
use dimos_core::arm::{EffortKind, IoInfo, IoState, JointStatus, Load, Setpoint, StopPoint};
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_core::joint::{ControlMode, JointLimits, MAX_DOF};
use dimos_hardware::adapter::{
    AdapterError, AdapterResult, ForceTorque, Gripper, HandGuiding, Io, JointMonitor, JointReading, ManipulatorAdapter,
    ManipulatorInfo, Payload, RobotState, Stop,
};
use dimos_hardware::adapter_util::{fill, within};
use dimos_hardware::registry::AdapterConfig;
use dimos_hardware::sim::faults::{Fault, FaultKind};
use dimos_hardware::sim::io::{MAX_VOLTAGE, SimIo};

/// An ideal arm in memory.
pub struct MockArm {
    options: Options,
    dof: usize,
    pub(super) device: Device,
    /// The last reading, for the fault `frozen`.
    measured: Option<JointReading>,
}

impl MockArm {
    /// A mock arm on the monotonic clock.
    pub fn new(config: &AdapterConfig) -> AdapterResult<Self> {
        Self::with_clock(config, Arc::new(MonotonicClock))
    }

    /// A mock arm on another clock, for tests. Latency and stalls still block in real time.
    pub fn with_clock(config: &AdapterConfig, clock: Arc<dyn Clock>) -> AdapterResult<Self> {
        config.check(check)?;
        let (options, dof) = (config.options::<Options>()?, config.dof);
        Ok(Self { device: Device::new(dof, &options, clock)?, options, dof, measured: None })
    }

    /// Injects a fault that begins `fault.at` seconds from now; the error lists the kinds that it can play.
    pub fn inject(&mut self, fault: Fault) -> Result<(), String> {
        self.device.inject(fault)
    }

    fn check_joints(&self, values: &[f64]) -> AdapterResult<()> {
        if values.len() == self.dof && values.iter().all(|value| value.is_finite()) {
            Ok(())
        } else {
            Err(AdapterError::Rejected(format!("expected {} finite values, one per joint", self.dof)))
        }
    }
}

impl ManipulatorAdapter for MockArm {
    fn connect(&mut self) -> AdapterResult<()> {
        self.device.connect()
    }

    fn disconnect(&mut self) {
        self.device.disconnect();
    }

    fn is_connected(&self) -> bool {
        self.device.connected
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
        self.device.write()?;
        self.device.arm.set_mode(mode).map_err(|refusal| self.device.arm.rejected(refusal))
    }

    fn get_control_mode(&self) -> ControlMode {
        self.device.arm.mode()
    }

    fn read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()> {
        self.device.read()?;
        let values = self.device.reported_positions();
        fill(positions, &values);
        Ok(())
    }

    fn read_joint_velocities(&mut self, velocities: &mut [f64]) -> AdapterResult<bool> {
        self.device.answer()?;
        fill(velocities, &self.device.arm.joints().1);
        Ok(self.options.velocity_feedback)
    }

    fn read_joint_efforts(&mut self, efforts: &mut [f64]) -> AdapterResult<bool> {
        self.device.answer()?;
        fill(efforts, &self.device.arm.efforts());
        Ok(self.options.effort_feedback)
    }

    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        self.device.read()?;
        if let Some(before) = self.measured
            && self.device.arm.take_fault(FaultKind::Frozen).is_some()
        {
            *reading = before;
            return Ok(());
        }
        let zero = [0.0; MAX_DOF];
        let position = self.device.reported_positions();
        // Entries past dof stay zero, also when the others are NaN.
        reading.position = zero;
        fill(reading.position.get_mut(..self.dof).unwrap_or_default(), &position);
        reading.velocity = self.options.velocity_feedback.then(|| self.device.arm.joints().1);
        reading.effort = self.options.effort_feedback.then(|| self.device.arm.efforts());
        reading.effort_kind = if self.options.effort_feedback { EffortKind::Measured } else { EffortKind::Unstated };
        reading.stamp = Some(self.device.arm.now());
        reading.device_ns = Some(self.device.arm.uptime().as_nanos() as u64);
        reading.valid = Some(position == self.device.arm.joints().0);
        self.measured = Some(*reading);
        Ok(())
    }

    fn read_state(&mut self) -> AdapterResult<RobotState> {
        self.device.answer()?;
        let arm = &self.device.arm;
        let mode = MODES.iter().position(|mode| *mode == arm.mode()).unwrap_or_default();
        Ok(RobotState { state: arm.state_code().into(), mode: mode as i32 })
    }

    fn read_error(&mut self) -> AdapterResult<(i32, String)> {
        self.device.answer()?;
        Ok((self.device.arm.error().into(), self.device.arm.error_text()))
    }

    fn read_enabled(&mut self) -> AdapterResult<bool> {
        self.device.answer()?;
        Ok(self.device.arm.enabled())
    }

    fn write_joint_positions(&mut self, positions: &[f64], velocity: f64) -> AdapterResult<()> {
        self.check_joints(positions)?;
        self.device.write_motion()?;
        let result = match self.device.arm.mode() {
            ControlMode::Position => self.device.arm.move_to(positions, velocity),
            ControlMode::ServoPosition => self.device.arm.servo(positions),
            mode => return Err(AdapterError::Rejected(format!("joint positions in {} mode", mode.name()))),
        };
        result.map_err(|refusal| self.device.arm.rejected(refusal))
    }

    fn write_joint_velocities(&mut self, velocities: &[f64]) -> AdapterResult<()> {
        self.check_joints(velocities)?;
        self.device.write_motion()?;
        let mode = self.device.arm.mode();
        if mode != ControlMode::Velocity {
            return Err(AdapterError::Rejected(format!("joint velocities in {} mode", mode.name())));
        }
        self.device.arm.velocity(velocities).map_err(|refusal| self.device.arm.rejected(refusal))
    }

    fn write_setpoint(&mut self, setpoint: &Setpoint) -> AdapterResult<()> {
        if setpoint.mode == ControlMode::Position {
            return self.write_joint_positions(setpoint.position.get(..self.dof).unwrap_or_default(), 1.0);
        }
        self.check_joints(setpoint.position.get(..self.dof).unwrap_or_default())?;
        self.device.write_motion()?;
        if self.device.arm.mode() != setpoint.mode {
            let (wanted, mode) = (setpoint.mode.name(), self.device.arm.mode().name());
            return Err(AdapterError::Rejected(format!("a setpoint for {wanted} in {mode} mode")));
        }
        self.device.arm.follow(setpoint).map_err(|refusal| self.device.arm.rejected(refusal))
    }

    fn write_stop(&mut self, _rest: &StopPoint) -> AdapterResult<Stop> {
        self.device.write()?;
        self.device.arm.stop();
        self.device.gripper.stop();
        Ok(Stop::Confirmed)
    }

    fn write_enable(&mut self, enable: bool) -> AdapterResult<()> {
        self.device.write()?;
        self.device.arm.enable(enable).map_err(|refusal| self.device.arm.rejected(refusal))
    }

    fn write_clear_errors(&mut self) -> AdapterResult<()> {
        self.device.write()?;
        self.device.arm.clear_error().map_err(|refusal| self.device.arm.rejected(refusal))
    }

    fn gripper(&mut self) -> Option<&mut dyn Gripper> {
        if self.options.gripper { Some(self) } else { None }
    }

    fn force_torque(&mut self) -> Option<&mut dyn ForceTorque> {
        if self.options.force_torque { Some(self) } else { None }
    }

    fn io(&mut self) -> Option<&mut dyn Io> {
        Some(self)
    }

    fn payload(&mut self) -> Option<&mut dyn Payload> {
        Some(self)
    }

    fn joint_monitor(&mut self) -> Option<&mut dyn JointMonitor> {
        Some(self)
    }

    fn hand_guiding(&mut self) -> Option<&mut dyn HandGuiding> {
        Some(self)
    }
}

impl HandGuiding for MockArm {
    fn begin_hand_guiding(&mut self) -> AdapterResult<()> {
        self.device.write()?;
        self.device.arm.guide().map_err(|refusal| self.device.arm.rejected(refusal))
    }
}

impl Gripper for MockArm {
    fn read_gripper_position(&mut self) -> AdapterResult<Option<f64>> {
        self.device.answer()?;
        Ok(Some(self.device.gripper.position))
    }

    fn get_gripper_range(&mut self) -> Option<(f64, f64)> {
        Some((0.0, GRIPPER_MAX))
    }

    fn write_gripper_position(&mut self, position: f64) -> AdapterResult<()> {
        self.write_gripper_position_with_force(position, GRIPPER_DEFAULT_FORCE)
    }

    fn get_gripper_force_range(&mut self) -> Option<(f64, f64)> {
        Some(GRIPPER_FORCE)
    }

    fn write_gripper_position_with_force(&mut self, position: f64, force: f64) -> AdapterResult<()> {
        self.device.write_motion()?;
        within("gripper opening", position, (0.0, GRIPPER_MAX), "m")?;
        within("gripper force", force, GRIPPER_FORCE, "N")?;
        self.device.gripper.max_force = force;
        self.device.gripper.move_to(position);
        Ok(())
    }

    fn has_gripper_speed(&self) -> bool {
        true
    }

    fn set_gripper_speed(&mut self, fraction: Option<f64>) {
        self.device.gripper.set_speed(fraction.unwrap_or(1.0));
    }

    fn read_gripper_force(&mut self) -> AdapterResult<Option<f64>> {
        self.device.answer()?;
        Ok(Some(self.device.gripper.force()))
    }
}

impl Io for MockArm {
    fn get_io(&self) -> IoInfo {
        SimIo::INFO
    }

    fn read_io(&mut self, state: &mut IoState) -> AdapterResult<()> {
        self.device.answer()?;
        *state = self.device.io.state();
        Ok(())
    }

    fn write_digital_output(&mut self, output: u8, high: bool) -> AdapterResult<()> {
        self.device.write()?;
        let there = self.device.io.set_output(output, high);
        there.then_some(()).ok_or_else(|| AdapterError::Rejected(format!("there is no digital output {output}")))
    }

    fn write_analog_output(&mut self, output: u8, value: f64) -> AdapterResult<()> {
        self.device.write()?;
        let set = self.device.io.set_voltage(output, value);
        let refused = || format!("analogue output {output} cannot be {value} V: there are two, 0 to {MAX_VOLTAGE} V");
        set.then_some(()).ok_or_else(|| AdapterError::Rejected(refused()))
    }
}

impl JointMonitor for MockArm {
    fn read_joint_status(&mut self, joints: &mut [JointStatus]) -> AdapterResult<()> {
        self.device.answer()?;
        joints.fill(JointStatus { temperature: Some(25.0), error: Some(0), ..JointStatus::default() });
        Ok(())
    }
}

impl Payload for MockArm {
    fn read_payload(&mut self) -> AdapterResult<Option<Load>> {
        self.device.answer()?;
        Ok(Some(self.device.load))
    }

    fn write_payload(&mut self, load: &Load) -> AdapterResult<()> {
        self.device.write()?;
        self.device.load = *load;
        Ok(())
    }

    fn read_mounting(&mut self) -> AdapterResult<Option<[f64; 3]>> {
        self.device.answer()?;
        Ok(Some(self.device.gravity))
    }

    fn write_mounting(&mut self, gravity: [f64; 3]) -> AdapterResult<()> {
        self.device.write()?;
        self.device.gravity = gravity;
        Ok(())
    }
}

impl ForceTorque for MockArm {
    fn read_force_torque(&mut self) -> AdapterResult<Option<[f64; 6]>> {
        self.device.answer()?;
        Ok(Some([0.0; 6]))
    }
}
