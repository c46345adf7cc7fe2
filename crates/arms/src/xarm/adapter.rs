//! The xArm adapter: the adapter trait on one side, a [`Session`] with the controller on the other.
//!
//! Wire: rad, rad/s, Nm, but millimetres. Here: SI units. The conversions between the two are in this file, those of
//! the gripper's pulses in `protocol/gripper.rs`.

mod parts;

use std::os::fd::BorrowedFd;
use std::time::Duration;

use super::address::Address;
use super::condition::Condition;
use super::connect::{connect, ends_velocities};
pub use super::control::Counts;
use super::model::{Model, VELOCITY};
use super::protocol::commands::{Command, WireJoints};
use super::protocol::gripper::GripperKind;
use super::protocol::report::Motion;
use super::report_validity::{measured, pose};
use super::session::Session;
use super::{HOLDS_WHEN_DISABLED, MODES, MODES_WITHOUT_VELOCITY, Options, check, model_of};
use dimos_core::arm::{ControllerPose, EffortKind, JointStatus, StopPoint};
use dimos_core::joint::{ControlMode, JointLimits, joints_of};
use dimos_hardware::adapter::{
    AdapterError, AdapterResult, Cartesian, ForceTorque, Gripper, HandGuiding, JointMonitor, JointReading,
    ManipulatorAdapter, ManipulatorInfo, Payload, Reduction, RobotState, Stop,
};
use dimos_hardware::registry::AdapterConfig;

/// The controller's modes that the adapter uses.
const PLANNED: u8 = 0;
const SERVO: u8 = 1;
const GUIDED: u8 = 2;
const JOINT_VELOCITY: u8 = 4;

/// Maximum age of the state that answers further reads of a cycle.
const RECENT: Duration = Duration::from_millis(2);
/// Accelerations of planned moves: the vendor's own defaults [rad/s², mm/s²].
const JOINT_ACCELERATION: f64 = 8.726_646;
const LINE_ACCELERATION: f64 = 2000.0;
/// Slowest planned moves that the controller accepts [rad/s, mm/s].
const SLOWEST: (f64, f64) = (1e-4, 0.1);
/// The arm stops when no velocity follows within this time [s].
const VELOCITY_TIMEOUT: f64 = 0.2;
/// Planned moves to targets closer than this are the same move [rad].
const SAME_TARGET: f64 = 1e-6;

/// An xArm, Lite 6 or 850 behind its control box.
pub struct XArmAdapter {
    address: Address,
    model: Model,
    options: Options,
    session: Option<Session>,
    /// The target of the last planned move: the controller queues moves, so the same one is not sent twice.
    target: Option<WireJoints>,
}

impl XArmAdapter {
    /// Creates an adapter for the controller at `config.address`. Does not connect.
    pub fn new(config: &AdapterConfig) -> AdapterResult<Self> {
        config.check(check)?;
        let options: Options = config.options()?;
        let model = model_of(&options, config.dof)?;
        let address = config.parse_address(Address::parse)?;
        Ok(Self { address, model, options, session: None, target: None })
    }

    /// Returns the counts of requests on the present connection.
    pub fn counts(&self) -> Option<Counts> {
        self.session.as_ref().map(Session::counts)
    }

    /// Calls `act` with the connection; drops a broken one.
    fn with<T>(&mut self, act: impl FnOnce(&mut Session) -> AdapterResult<T>) -> AdapterResult<T> {
        let result = act(self.session.as_mut().ok_or(AdapterError::NotConnected)?);
        if matches!(result, Err(AdapterError::Io(_))) {
            // What has not left this computer must not reach the arm later.
            self.discard_pending();
        }
        result
    }

    /// Returns the connection, with its state updated recently.
    fn recent(&mut self) -> AdapterResult<&mut Session> {
        self.with(|session| session.update(RECENT))?;
        self.session.as_mut().ok_or(AdapterError::NotConnected)
    }

    /// Returns the modes of this arm, given its firmware.
    fn modes(&self) -> &'static [ControlMode] {
        let old = self.session.as_ref().is_some_and(|session| !ends_velocities(session.device.firmware));
        if old { MODES_WITHOUT_VELOCITY } else { MODES }
    }

    /// Converts joint values to those of the wire.
    fn joints(&self, values: &[f64]) -> AdapterResult<WireJoints> {
        let dof = self.model.axes();
        if values.len() != dof || !values.iter().all(|value| value.is_finite()) {
            return Err(AdapterError::Rejected(format!("expected {dof} finite values, one per joint")));
        }
        let mut joints = [0.0; 7];
        joints.iter_mut().zip(values).for_each(|(to, value)| *to = *value);
        Ok(joints)
    }

    /// Copies values of the wire.
    fn fill(&self, out: &mut [f64], values: &[f64; 7]) {
        out.iter_mut().zip(values).take(self.model.axes()).for_each(|(to, value)| *to = *value);
    }

    /// Returns the speed of a planned move from a fraction of the top speed.
    fn speed(&self, fraction: f64, top: f64, slowest: f64) -> f64 {
        let fraction = if fraction.is_finite() { fraction.clamp(0.0, 1.0) } else { 0.0 };
        (fraction * self.options.speed_scale * top).max(slowest)
    }

    /// Returns the values of the arm's joints; it may have fewer than seven.
    fn only<const N: usize>(&self, values: &[f64; N]) -> dimos_core::joint::Joints {
        joints_of(values.get(..self.model.axes()).unwrap_or_default())
    }
}

/// What a run logs of a controller whose reports hide what the joints do.
const COMMANDED_POSITIONS: &str = "its controller reports commanded positions, not measured ones (firmware before 2.4.0 \
     at port 30003): tracking supervision sees no difference, only the controller's own collision detection sees a blocked joint";

impl ManipulatorAdapter for XArmAdapter {
    // --- Lifecycle ---

    fn connect(&mut self) -> AdapterResult<()> {
        self.disconnect();
        self.session = Some(connect(&self.address, self.model, &self.options)?);
        Ok(())
    }

    fn disconnect(&mut self) {
        (self.session, self.target) = (None, None);
    }

    fn discard_pending(&mut self) {
        self.target = None;
        self.session.take().into_iter().for_each(Session::abort);
    }

    /// Does not stop an arm that another client has taken over.
    fn deactivate(&mut self, rest: &StopPoint) -> AdapterResult<()> {
        match self.session.as_ref().and_then(Session::foreign_change) {
            Some(_) => Ok(()),
            None => self.write_stop(rest).map(drop),
        }
    }

    fn is_connected(&self) -> bool {
        self.session.is_some()
    }

    /// Activates in servo mode, which the coordinator uses first: a later change of mode would go through a stop.
    fn activate(&mut self) -> AdapterResult<()> {
        let force_torque = self.options.force_torque;
        self.target = None;
        self.with(|session| session.activate(SERVO, force_torque))
    }

    // --- Identity ---

    fn get_info(&self) -> ManipulatorInfo {
        let device = self.session.as_ref().map(|session| &session.device);
        ManipulatorInfo {
            vendor: "UFACTORY".into(),
            model: self.model.name().into(),
            dof: self.model.axes(),
            firmware_version: device.map(|device| device.firmware.to_string()),
            serial_number: device.map(|device| device.serial.clone()),
            native_rate: self.session.as_ref().map_or(super::NATIVE_RATE, Session::rate),
            modes: self.modes(),
            holds_when_disabled: HOLDS_WHEN_DISABLED,
            whole_state_at_once: true,
        }
    }

    fn connection_warning(&self) -> Option<&'static str> {
        let blind = self.session.as_ref().is_some_and(Session::reports_commanded);
        blind.then_some(COMMANDED_POSITIONS)
    }

    fn get_dof(&self) -> usize {
        self.model.axes()
    }

    fn get_limits(&mut self) -> AdapterResult<JointLimits> {
        Ok(self.session.as_mut().map_or_else(|| self.model.limits(), Session::limits))
    }

    fn reduction(&self) -> Option<Reduction> {
        self.session.as_ref()?.reduction()
    }

    fn reduction_changed(&self) -> bool {
        self.session.as_ref().is_some_and(Session::reduction_changed)
    }

    // --- Mode ---

    fn set_control_mode(&mut self, mode: ControlMode) -> AdapterResult<()> {
        if mode == ControlMode::Velocity && !self.modes().contains(&mode) {
            let firmware = self.session.as_ref().map(|session| session.device.firmware.to_string()).unwrap_or_default();
            return Err(AdapterError::Rejected(format!(
                "velocity mode needs firmware 1.8.0 or newer, which ends a velocity when no other follows; this \
                 controller has {firmware}\nhint: update the controller's firmware, or use position tasks"
            )));
        }
        let mode = match mode {
            ControlMode::Position => PLANNED,
            ControlMode::ServoPosition => SERVO,
            ControlMode::Velocity => JOINT_VELOCITY,
            _ => return Err(AdapterError::Unsupported),
        };
        self.target = None;
        self.with(|session| session.set_mode(mode))
    }

    fn get_control_mode(&self) -> ControlMode {
        // A mode that the adapter does not use is reported as the most similar one that `set_control_mode` refuses, so
        // that it never counts as a used one.
        match self.session.as_ref().map_or(PLANNED, |session| session.motion().0.mode) {
            PLANNED => ControlMode::Position,
            SERVO => ControlMode::ServoPosition,
            JOINT_VELOCITY => ControlMode::Velocity,
            GUIDED | 3 => ControlMode::Impedance,
            5 => ControlMode::CartesianVelocity,
            _ => ControlMode::Cartesian,
        }
    }

    fn foreign_change(&self) -> Option<&'static str> {
        self.session.as_ref().and_then(Session::foreign_change)
    }

    // --- State ---

    fn state_fd(&self) -> Option<BorrowedFd<'_>> {
        self.session.as_ref().map(Session::fd)
    }

    fn read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()> {
        self.with(|session| session.update(Duration::ZERO))?;
        let position = self.recent()?.motion().0.position;
        self.fill(positions, &position);
        Ok(())
    }

    fn read_joint_velocities(&mut self, velocities: &mut [f64]) -> AdapterResult<bool> {
        let velocity = self.recent()?.motion().0.velocity;
        velocity.iter().for_each(|values| self.fill(velocities, values));
        Ok(velocity.is_some())
    }

    fn read_joint_efforts(&mut self, efforts: &mut [f64]) -> AdapterResult<bool> {
        let session = self.recent()?;
        let (torque, torques) = (session.motion().0.torque, session.device.torques);
        if torques {
            self.fill(efforts, &torque);
        }
        Ok(torques)
    }

    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        self.with(|session| session.update(Duration::ZERO))?;
        let session = self.session.as_ref().ok_or(AdapterError::NotConnected)?;
        let (motion, stamp) = session.motion();
        *reading = JointReading {
            stamp: Some(stamp),
            device_ns: motion.time_us.map(|us| us.saturating_mul(1000)),
            position: self.only(&motion.position),
            velocity: motion.velocity.map(|velocity| self.only(&velocity)),
            effort: session.device.torques.then(|| self.only(&motion.torque)),
            effort_kind: EffortKind::FromCurrent,
            valid: measured(motion, self.model, &stated(motion, session.condition())),
            ..JointReading::default()
        };
        Ok(())
    }

    fn read_state(&mut self) -> AdapterResult<RobotState> {
        let (motion, _) = self.recent()?.motion();
        Ok(RobotState { state: motion.state.into(), mode: motion.mode.into() })
    }

    fn read_error(&mut self) -> AdapterResult<(i32, String)> {
        let condition = self.recent()?.condition();
        Ok((condition.error.into(), condition.text())) // an empty text allocates nothing
    }

    fn read_enabled(&mut self) -> AdapterResult<bool> {
        Ok(self.recent()?.enabled())
    }

    // --- Motion ---

    fn write_joint_positions(&mut self, positions: &[f64], velocity: f64) -> AdapterResult<()> {
        let joints = self.joints(positions)?;
        let mode = self.session.as_ref().ok_or(AdapterError::NotConnected)?.motion().0.mode;
        if mode != PLANNED {
            return self.with(|session| session.stream(SERVO, &Command::Servo(joints)));
        }
        let same = |target: WireJoints| target.iter().zip(&joints).all(|(a, b)| (a - b).abs() < SAME_TARGET);
        let speed = self.speed(velocity, VELOCITY, SLOWEST.0);
        let known = self.target.is_some_and(same);
        let command = Command::MoveJoints { joints, speed, acceleration: JOINT_ACCELERATION };
        self.with(|session| if known { session.may_plan() } else { session.plan(&command) })?;
        self.target = Some(joints);
        Ok(())
    }

    fn write_joint_velocities(&mut self, velocities: &[f64]) -> AdapterResult<()> {
        let joints = self.joints(velocities)?;
        if !self.modes().contains(&ControlMode::Velocity) {
            return Err(AdapterError::Unsupported);
        }
        let command = Command::Velocity { joints, duration: Some(VELOCITY_TIMEOUT) };
        self.with(|session| session.stream(JOINT_VELOCITY, &command))
    }

    fn write_stop(&mut self, _rest: &StopPoint) -> AdapterResult<Stop> {
        self.target = None;
        self.with(Session::stop)
    }

    /// After enabling, the arm is ready in its present mode, or in servo mode.
    fn write_enable(&mut self, enable: bool) -> AdapterResult<()> {
        self.target = None;
        let modes = self.modes();
        self.with(|session| {
            if !enable {
                return session.enable(false);
            }
            let velocity = modes.contains(&ControlMode::Velocity);
            let mode = match session.motion().0.mode {
                PLANNED => PLANNED,
                JOINT_VELOCITY if velocity => JOINT_VELOCITY,
                _ => SERVO,
            };
            session.activate(mode, false)
        })
    }

    fn write_clear_errors(&mut self) -> AdapterResult<()> {
        self.target = None;
        self.with(Session::clear_errors)
    }

    // --- Optional parts ---

    fn gripper(&mut self) -> Option<&mut dyn Gripper> {
        if self.options.gripper == GripperKind::None { None } else { Some(self) }
    }

    fn force_torque(&mut self) -> Option<&mut dyn ForceTorque> {
        if self.options.force_torque { Some(self) } else { None }
    }

    fn cartesian(&mut self) -> Option<&mut dyn Cartesian> {
        Some(self)
    }

    fn payload(&mut self) -> Option<&mut dyn Payload> {
        Some(self)
    }

    /// Older firmware reports neither temperatures nor errors of the joints.
    fn joint_monitor(&mut self) -> Option<&mut dyn JointMonitor> {
        let known = self.session.as_ref().is_some_and(|session| session.condition().motors.is_some());
        if known { Some(self) } else { None }
    }

    fn hand_guiding(&mut self) -> Option<&mut dyn HandGuiding> {
        Some(self)
    }
}

impl HandGuiding for XArmAdapter {
    fn begin_hand_guiding(&mut self) -> AdapterResult<()> {
        self.target = None;
        self.with(|session| session.set_mode(GUIDED))
    }
}

impl JointMonitor for XArmAdapter {
    fn read_joint_status(&mut self, joints: &mut [JointStatus]) -> AdapterResult<()> {
        let condition = self.recent()?.condition();
        let motors = condition.motors.unwrap_or_default();
        for (i, joint) in joints.iter_mut().enumerate() {
            let at = |values: Option<[f64; 7]>| values.and_then(|values| values.get(i).copied());
            *joint = JointStatus {
                temperature: motors.temperature.get(i).map(|celsius| f64::from(*celsius)),
                current: at(motors.current),
                voltage: at(motors.voltage),
                load: None,
                error: condition.servos.get(i).map(|code| i32::from(*code)),
            };
        }
        Ok(())
    }
}

/// Returns the pose of a report, with the offsets of the newest one that has them: five times a second.
fn stated(motion: &Motion, condition: &Condition) -> ControllerPose {
    let (tool, base) = (condition.tool.as_ref().map(pose), condition.base.as_ref().map(pose));
    ControllerPose { tcp: pose(&motion.pose), tool, base }
}
