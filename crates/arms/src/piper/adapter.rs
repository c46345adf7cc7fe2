//! The Piper adapter: the adapter trait on one side, the arm's CAN frames on the other.
//!
//! Wire: 0.001°, 0.001 mm, 0.001 rad/s, mA. Here: rad, m, rad/s, Nm. The conversions are in this file, those of angles
//! in `protocol.rs`.
//!
//! The arm streams its state, 200 times per second; after `connect` nothing is polled. It does not acknowledge joint
//! targets, so enabling, clearing and stopping are confirmed by its feedback.
//!
//! Only `write_enable(false)` disables the motors: the arm has no brakes. A stop is a hold at the point that the caller
//! gives. The arm's own E-stop command is never sent: it can only be left by a reset that lets the arm fall.

use std::os::fd::BorrowedFd;
use std::time::Duration;

use super::feedback::{Counts, Feedback, STANDSTILL};
use super::hold;
use super::protocol::{self, DOF, WireJoints, millidegrees, radians};
use super::session::{ESTOP, Session};
use super::wire::{Wire, WireCounts};
use super::{Follow, HOLDS_WHEN_DISABLED, MODES, NATIVE_RATE, Options, check};
use dimos_core::arm::{ControllerPose, EffortKind, ForceUnit, JointStatus, Pose, StopPoint};
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_core::joint::{ControlMode, JointLimits, Joints, joints_of};
use dimos_hardware::adapter::{
    AdapterError, AdapterResult, Cartesian, Gripper, JointMonitor, JointReading, ManipulatorAdapter, ManipulatorInfo,
    RobotState, Stop,
};
use dimos_hardware::adapter_util::fill;
use dimos_hardware::registry::AdapterConfig;
use dimos_hardware::transport::can::CanAddress;

/// How long a stop waits for the joints to decelerate, and the change of speed that shows it [0.001 rad/s].
const STOP_TIMEOUT: Duration = Duration::from_millis(20);
const DECELERATION: i32 = 20;
/// How far outside its limits a target may be [rad]: the coordinator keeps the limits, but an arm outside must be able
/// to return.
const MARGIN: f64 = 0.1;
/// Motor torque per current [Nm/A]: joints 1 to 3, and 4 to 6.
const TORQUE: [f64; DOF] = [1.18125, 1.18125, 1.18125, 0.95844, 0.95844, 0.95844];
/// Up to this firmware the arm reports a quarter of the current of its first three joints.
const QUARTER_CURRENT: (u8, u8, u8) = (1, 8, 2);

/// Bit of a driver's status that is no error: the motor is on.
const ENABLED: u8 = 0x40;

/// Smallest and largest torque of the gripper's motor that can be commanded [Nm].
const GRIPPER_TORQUE: (f64, f64) = (0.001, 5.0);

const MICRO: f64 = 1e-6;
const MILLI: f64 = 1e-3;

/// A Piper on its bus.
pub struct PiperAdapter {
    arm: Session,
    options: Options,
    mode: ControlMode,
    /// Largest torque of the last gripper command [mNm]; initially that of the options.
    gripper_torque: u16,
    /// Target of the last gripper command since the connection [0.001 mm].
    gripper_target: Option<i32>,
}

impl PiperAdapter {
    /// Creates an adapter for the arm on the bus at `config.address`. Does not connect.
    pub fn new(config: &AdapterConfig) -> AdapterResult<Self> {
        config.check(check)?;
        let address = config.parse_address(CanAddress::parse)?;
        let options: Options = config.options()?;
        let arm = Session::new(config.hardware_id.clone(), address, options.model, options.gripper.stroke().is_some());
        let gripper_torque = millinewtonmeters(options.gripper_torque);
        Ok(Self { arm, options, mode: ControlMode::Position, gripper_torque, gripper_target: None })
    }

    /// Returns the counts since the connection was made: frames of the arm, and of the bus.
    pub fn counts(&self) -> (Counts, WireCounts) {
        (self.arm.feedback.counts, self.arm.wire.as_ref().map(|wire| wire.counts).unwrap_or_default())
    }

    /// Returns the speed of a planned move [%] from a fraction of the top speed.
    fn percent(&self, velocity: f64) -> u8 {
        (velocity * self.options.speed_scale * 100.0).round().clamp(1.0, 100.0) as u8
    }

    fn follow(&self) -> protocol::Follow {
        match (self.mode, self.options.follow) {
            (ControlMode::ServoPosition, Follow::Direct) => protocol::Follow::Direct,
            _ => protocol::Follow::Smooth,
        }
    }

    /// Velocities [rad/s]; `None` if a motor has not reported its own recently.
    fn velocities(&self) -> Option<Joints> {
        let known = self.arm.measures();
        known.then(|| joints_of(&self.arm.feedback.motors.map(|motor| f64::from(motor.speed) * MILLI)))
    }

    /// Torques [Nm]; `None` if a motor has not reported its current recently, or if the firmware, which determines the
    /// unit of the currents, is unknown.
    fn efforts(&self) -> Option<Joints> {
        if !self.arm.measures() {
            return None;
        }
        let quarter = self.arm.feedback.firmware()? <= QUARTER_CURRENT;
        let mut efforts = [0.0; DOF];
        let motors = self.arm.feedback.motors.iter().zip(TORQUE).enumerate();
        for (effort, (joint, (motor, torque))) in efforts.iter_mut().zip(motors) {
            let scale = if quarter && joint < 3 { 4.0 } else { 1.0 };
            *effort = f64::from(motor.current) * MILLI * torque * scale;
        }
        Some(joints_of(&efforts))
    }
}

impl ManipulatorAdapter for PiperAdapter {
    // --- Lifecycle ---

    fn connect(&mut self) -> AdapterResult<()> {
        self.disconnect();
        self.gripper_target = None;
        self.arm.connect()
    }

    fn disconnect(&mut self) {
        self.arm.wire = None;
    }

    fn is_connected(&self) -> bool {
        self.arm.wire.is_some()
    }

    // --- Identity ---

    fn get_info(&self) -> ManipulatorInfo {
        ManipulatorInfo {
            vendor: "AgileX".into(),
            model: self.options.model.name().into(),
            dof: DOF,
            firmware_version: self.arm.feedback.firmware().map(|(a, b, c)| format!("S-V{a}.{b}-{c}")),
            serial_number: None,
            native_rate: NATIVE_RATE,
            modes: MODES,
            holds_when_disabled: HOLDS_WHEN_DISABLED,
            whole_state_at_once: true,
        }
    }

    fn get_dof(&self) -> usize {
        DOF
    }

    /// Returns the limits of the data sheet, narrowed by those of the controller.
    fn get_limits(&mut self) -> AdapterResult<JointLimits> {
        let (limits, odd) = self.arm.limits();
        odd.iter().for_each(|what| tracing::warn!("{}", self.arm.about(what)));
        Ok(limits)
    }

    // --- Mode ---

    /// Both modes are MOVE J and differ only in the frame before each target, so nothing is sent here.
    fn set_control_mode(&mut self, mode: ControlMode) -> AdapterResult<()> {
        if !MODES.contains(&mode) {
            return Err(AdapterError::Unsupported);
        }
        self.arm.known()?;
        self.arm.ours()?;
        self.mode = mode;
        Ok(())
    }

    /// Returns the ordered mode, or another one if another client has changed it.
    fn get_control_mode(&self) -> ControlMode {
        self.arm.feedback.guard.change.map_or(self.mode, |change| change.mode(self.mode))
    }

    // --- State ---

    fn state_fd(&self) -> Option<BorrowedFd<'_>> {
        self.arm.wire.as_ref().map(Wire::fd)
    }

    fn read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()> {
        self.arm.whole()?;
        fill(positions, &self.arm.feedback.joints.map(radians));
        Ok(())
    }

    fn read_joint_velocities(&mut self, velocities: &mut [f64]) -> AdapterResult<bool> {
        self.arm.known()?;
        let known = self.velocities();
        known.iter().for_each(|known| fill(velocities, known));
        Ok(known.is_some())
    }

    fn read_joint_efforts(&mut self, efforts: &mut [f64]) -> AdapterResult<bool> {
        self.arm.known()?;
        let known = self.efforts();
        known.iter().for_each(|known| fill(efforts, known));
        Ok(known.is_some())
    }

    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        self.arm.whole()?;
        *reading = JointReading {
            stamp: Some(self.arm.feedback.joints_at),
            position: joints_of(&self.arm.feedback.joints.map(radians)),
            velocity: self.velocities(),
            effort: self.efforts(),
            effort_kind: EffortKind::FromCurrent,
            valid: self.arm.valid(),
            ..JointReading::default()
        };
        Ok(())
    }

    /// State: the arm's own (0 = normal, 1 = E-stop …); mode: who controls it (0 = none, 1 = CAN, 2 = teaching …).
    fn read_state(&mut self) -> AdapterResult<RobotState> {
        let status = self.arm.known()?.status;
        Ok(RobotState { state: status.arm.into(), mode: status.control.into() })
    }

    fn read_error(&mut self) -> AdapterResult<(i32, String)> {
        let feedback = self.arm.known()?;
        Ok((feedback.error_code(), feedback.error_text())) // an empty text allocates nothing
    }

    fn read_enabled(&mut self) -> AdapterResult<bool> {
        let feedback = self.arm.known()?;
        Ok(feedback.enabled() && !feedback.guard.just_off(MonotonicClock.now()))
    }

    // --- Motion ---

    fn write_joint_positions(&mut self, positions: &[f64], velocity: f64) -> AdapterResult<()> {
        let Ok(positions) = <[f64; DOF]>::try_from(positions) else {
            return Err(self.arm.refuse(format!("{DOF} values are needed, one per joint")));
        };
        for (i, (value, (lower, upper))) in positions.iter().zip(self.options.model.ranges()).enumerate() {
            // NaN is not inside either.
            if !(lower - MARGIN..=upper + MARGIN).contains(value) {
                let joint = i + 1;
                return Err(self.arm.refuse(format!("joint {joint}: {value} rad is not within {lower} to {upper}")));
            }
        }
        match self.arm.may_move() {
            // Silence: nothing goes out, and a setpoint that was not sent must not count as one that may have arrived.
            Err(AdapterError::Timeout(_)) => return Err(AdapterError::Busy),
            result => result?,
        }
        if !self.arm.has_room() {
            return Err(AdapterError::Busy);
        }
        let mut joints: WireJoints = positions.map(millidegrees);
        for (i, target) in joints.iter_mut().enumerate() {
            *target = self.arm.limited(i, *target);
        }
        match self.mode {
            ControlMode::ServoPosition => self.arm.stream(self.follow(), joints),
            _ => self.arm.write(self.percent(velocity), self.follow(), joints),
        }
    }

    /// Holds the arm at the point of rest. Confirmed when the feedback shows that every joint decelerates or is at
    /// rest.
    fn write_stop(&mut self, rest: &StopPoint) -> AdapterResult<Stop> {
        self.arm.refresh()?; // nothing goes out to an arm that is silent
        let before = self.arm.feedback.motors.map(|motor| i32::from(motor.speed).abs());
        if self.arm.feedback.enabled() && self.arm.feedback.status.arm != ESTOP {
            self.arm.stop(rest, self.follow())?;
        }
        let sent = MonotonicClock.now();
        let slower = |feedback: &Feedback| {
            let speeds = feedback.motors.iter().map(|motor| i32::from(motor.speed).abs());
            feedback.motors_heard(sent)
                && speeds.zip(before).all(|(now, then)| now <= STANDSTILL || now + DECELERATION <= then)
        };
        Ok(if self.arm.watch(STOP_TIMEOUT, slower)? { Stop::Confirmed } else { Stop::Sent })
    }

    /// Enabling holds the arm at its position: the target is set before the motors come on, and again when they are on.
    fn write_enable(&mut self, enable: bool) -> AdapterResult<()> {
        if !enable {
            self.arm.drain()?;
            self.arm.release();
            return self.arm.switch_motors(false);
        }
        self.arm.refresh()?;
        self.arm.in_order()?;
        let measured = self.arm.plausible()?;
        let were_on = self.arm.feedback.enabled();
        if were_on {
            self.arm.as_commanded(&measured)?;
        }
        self.arm.release();
        self.arm.written = self.arm.written.filter(|_| were_on);
        let set = self.arm.take_up_hold(&measured, self.follow())?;
        self.arm.switch_motors(true)?;
        self.arm.refresh()?;
        self.arm.confirm_hold(set, self.follow())?;
        self.arm.take_control()
    }

    fn write_clear_errors(&mut self) -> AdapterResult<()> {
        self.arm.refresh()?;
        if self.arm.feedback.status.arm == ESTOP {
            return self.arm.in_order();
        }
        self.arm.learn();
        self.arm.send(&[protocol::clear_errors()])?;
        if let Some(gripper) = self.arm.feedback.gripper.filter(|_| self.arm.feedback.gripper_errors().next().is_some())
        {
            // The frame has a target: its last one. Only a gripper that this run never commanded gets where it is.
            let stroke = self.gripper_target.unwrap_or(gripper.stroke);
            let frame = protocol::clear_gripper(stroke, self.gripper_torque, gripper.enabled());
            self.arm.send(&[frame])?;
        }
        let asked = MonotonicClock.now();
        let cleared = |p: &Feedback| p.drivers_heard(asked) && p.status_at > asked && p.error_code() == 0;
        if self.arm.watch(hold::CLEAR_TIMEOUT, cleared)? {
            if matches!(self.arm.feedback.status.control, 0 | 1) {
                self.arm.release();
            }
            return Ok(());
        }
        let (code, text) = (self.arm.feedback.error_code(), self.arm.feedback.error_text());
        Err(AdapterError::Fault { code, text })
    }

    /// Takes back setpoints that wait for the bus, if the bus allows it; otherwise nothing new is sent until they are
    /// out.
    fn discard_pending(&mut self) {
        self.arm.discard();
    }

    // --- Optional parts ---

    fn gripper(&mut self) -> Option<&mut dyn Gripper> {
        if self.options.gripper.stroke().is_some() { Some(self) } else { None }
    }

    fn cartesian(&mut self) -> Option<&mut dyn Cartesian> {
        Some(self)
    }

    fn joint_monitor(&mut self) -> Option<&mut dyn JointMonitor> {
        Some(self)
    }
}

/// Torque of the wire [mNm] from ours [Nm].
fn millinewtonmeters(torque: f64) -> u16 {
    (torque / MILLI).round() as u16
}

impl JointMonitor for PiperAdapter {
    /// From feedback that has arrived. A motor's current is absent while it is not reported, or its unit is unknown.
    fn read_joint_status(&mut self, joints: &mut [JointStatus]) -> AdapterResult<()> {
        let drivers = self.arm.known()?.drivers;
        let efforts = self.efforts();
        for (i, (joint, driver)) in joints.iter_mut().zip(&drivers).enumerate() {
            let temperature = driver.driver_temperature.max(driver.motor_temperature.into());
            let torque = efforts.as_ref().and_then(|efforts| efforts.get(i)).zip(TORQUE.get(i));
            *joint = JointStatus {
                temperature: Some(temperature.into()),
                current: torque.map(|(effort, per_ampere)| effort / per_ampere),
                voltage: Some(f64::from(driver.voltage) * 0.1),
                load: None,
                error: Some((driver.status & !ENABLED).into()),
            };
        }
        Ok(())
    }
}

impl Gripper for PiperAdapter {
    fn read_gripper_position(&mut self) -> AdapterResult<Option<f64>> {
        Ok(self.arm.known()?.gripper.map(|gripper| f64::from(gripper.stroke) * MICRO))
    }

    fn get_gripper_range(&mut self) -> Option<(f64, f64)> {
        self.options.gripper.stroke().map(|stroke| (0.0, stroke))
    }

    fn write_gripper_position(&mut self, position: f64) -> AdapterResult<()> {
        self.write_gripper_position_with_force(position, self.options.gripper_torque)
    }

    /// The vendor states the torque of the gripper's motor, not the force of its fingers.
    fn get_gripper_force_unit(&self) -> ForceUnit {
        ForceUnit::NewtonMeters
    }

    fn get_gripper_force_range(&mut self) -> Option<(f64, f64)> {
        Some(GRIPPER_TORQUE)
    }

    fn read_gripper_force(&mut self) -> AdapterResult<Option<f64>> {
        Ok(self.arm.known()?.gripper.map(|gripper| f64::from(gripper.torque) * MILLI))
    }

    fn write_gripper_position_with_force(&mut self, position: f64, force: f64) -> AdapterResult<()> {
        let stroke = self.options.gripper.stroke().ok_or(AdapterError::Unsupported)?;
        if !(0.0..=stroke).contains(&position) {
            return Err(self.arm.refuse(format!("gripper opening {position} m is not within 0 to {stroke} m")));
        }
        let (least, most) = GRIPPER_TORQUE;
        if !(least..=most).contains(&force) {
            return Err(self.arm.refuse(format!("gripper torque {force} Nm is not within {least} to {most} Nm")));
        }
        self.arm.may_move()?;
        let target = (position / MICRO).round() as i32;
        self.gripper_torque = millinewtonmeters(force);
        self.arm.send(&[protocol::gripper_target(target, self.gripper_torque)])?;
        self.gripper_target = Some(target);
        Ok(())
    }
}

impl Cartesian for PiperAdapter {
    fn read_cartesian_position(&mut self) -> AdapterResult<Option<ControllerPose>> {
        let pose = self.arm.known()?.pose.map(|[x, y, z, roll, pitch, yaw]| Pose {
            xyz: [x, y, z].map(|v| f64::from(v) * MICRO),
            rpy: [roll, pitch, yaw].map(radians),
        });
        Ok(pose.map(ControllerPose::of_flange))
    }

    fn write_cartesian_position(&mut self, pose: &Pose, velocity: f64) -> AdapterResult<()> {
        // Ten metres and ten turns are far beyond the arm's reach, and fit the wire's numbers.
        let sensible = pose.xyz.iter().all(|v| v.abs() < 10.0) && pose.rpy.iter().all(|v| v.abs() < 62.0);
        if !sensible {
            return Err(self.arm.refuse("the pose is not finite, or absurd".into()));
        }
        self.arm.may_move()?;
        let ([x, y, z], [roll, pitch, yaw]) =
            (pose.xyz.map(|v| (v / MICRO).round() as i32), pose.rpy.map(millidegrees));
        (self.arm.written, self.arm.control) = (None, None);
        self.arm.feedback.guard.order(protocol::MoveMode::Pose as u8, MonotonicClock.now());
        self.arm.send(&protocol::pose_target(self.percent(velocity), [x, y, z, roll, pitch, yaw]))
    }
}
