//! The adapter of Universal Robots' arms: the adapter trait on one side, a [`Session`] with a controller on the other.
//!
//! Wire and here: rad, rad/s, m, N, Nm. Orientations are rotation vectors on the wire.

use std::os::fd::BorrowedFd;
use std::time::Duration;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use super::address::Address;
use super::connect::connect;
use super::protocol::inputs::Order;
use super::safety::Stopped;
use super::session::Session;
use super::{DOF, HOLDS_WHEN_DISABLED, MODES, Options, check};
use dimos_core::arm::{Commanded, ControllerPose, FactoryKinematics, Pose, StopPoint};
use dimos_core::joint::{ControlMode, JointLimits, joints_of};
use dimos_hardware::adapter::{
    AdapterError, AdapterResult, Cartesian, ForceTorque, Io, JointMonitor, JointReading, ManipulatorAdapter,
    ManipulatorInfo, Payload, RobotState, Stop,
};
use dimos_hardware::adapter_util::{fill, finite};
use dimos_hardware::registry::AdapterConfig;

/// Maximum age of the state that answers further reads of a cycle.
const RECENT: Duration = Duration::from_millis(2);

/// An arm of Universal Robots behind its controller.
pub struct UrAdapter {
    address: Address,
    pub(super) options: Options,
    pub(super) session: Option<Session>,
    mode: ControlMode,
    /// The last stop by the safety system: it may outlast the connection, and its error is reported once.
    stopped: Option<Stopped>,
}

impl UrAdapter {
    /// Creates an adapter for the controller at `config.address`. Does not connect.
    pub fn new(config: &AdapterConfig) -> AdapterResult<Self> {
        config.check(check)?;
        let address = config.parse_address(Address::parse)?;
        Ok(Self { address, options: config.options()?, session: None, mode: ControlMode::ServoPosition, stopped: None })
    }

    /// Calls `act` with the connection; drops a broken one, with a stop as far as that is possible.
    pub(super) fn with<T>(&mut self, act: impl FnOnce(&mut Session) -> AdapterResult<T>) -> AdapterResult<T> {
        let result = act(self.session.as_mut().ok_or(AdapterError::NotConnected)?);
        if matches!(result, Err(AdapterError::Io(_))) {
            self.discard_pending();
        }
        result
    }

    /// Returns the connection, with its state updated recently.
    pub(super) fn recent(&mut self) -> AdapterResult<&mut Session> {
        self.with(|session| session.update(RECENT))?;
        self.session.as_mut().ok_or(AdapterError::NotConnected)
    }

    fn close(&mut self) -> Option<Session> {
        let session = self.session.take();
        if let Some(session) = &session {
            self.stopped = session.stopped;
        }
        session
    }
}

impl ManipulatorAdapter for UrAdapter {
    // --- Lifecycle ---

    fn connect(&mut self) -> AdapterResult<()> {
        self.disconnect();
        let mut session = connect(&self.address, &self.options)?;
        self.stopped.into_iter().for_each(|stopped| session.remember(stopped));
        self.session = Some(session);
        Ok(())
    }

    fn disconnect(&mut self) {
        self.close();
    }

    fn discard_pending(&mut self) {
        self.close().into_iter().for_each(Session::abort);
    }

    fn is_connected(&self) -> bool {
        self.session.is_some()
    }

    fn activate(&mut self) -> AdapterResult<()> {
        let options = self.options.clone();
        self.with(|session| session.activate(&options))
    }

    /// Does not stop an arm that another client has taken over.
    fn deactivate(&mut self, rest: &StopPoint) -> AdapterResult<()> {
        match self.session.as_ref().and_then(Session::foreign_change) {
            Some(_) => Ok(()),
            None => self.write_stop(rest).map(drop),
        }
    }

    // --- Identity ---

    fn get_info(&self) -> ManipulatorInfo {
        let device = self.session.as_ref().map(|session| &session.device);
        ManipulatorInfo {
            vendor: "Universal Robots".into(),
            model: self.options.model.name().into(),
            dof: DOF,
            firmware_version: device.map(|device| device.software.clone()),
            serial_number: device.and_then(|device| device.serial.clone()),
            native_rate: self.options.model.rate(),
            modes: MODES,
            holds_when_disabled: HOLDS_WHEN_DISABLED,
            whole_state_at_once: true,
        }
    }

    fn connection_warning(&self) -> Option<&'static str> {
        self.session.as_ref()?.device.warning
    }

    fn get_dof(&self) -> usize {
        DOF
    }

    fn get_limits(&mut self) -> AdapterResult<JointLimits> {
        let device = self.session.as_ref().map(|session| session.device.limits.clone());
        Ok(device.unwrap_or_else(|| self.options.limits()))
    }

    fn factory_kinematics(&self) -> Option<FactoryKinematics> {
        self.session.as_ref().map(|session| session.device.kinematics.clone())
    }

    // --- Mode ---

    fn set_control_mode(&mut self, mode: ControlMode) -> AdapterResult<()> {
        if !MODES.contains(&mode) {
            return Err(AdapterError::Unsupported);
        }
        let changes = mode != self.mode;
        self.with(|session| {
            session.update(Duration::ZERO)?;
            if changes && !session.at_rest() {
                session.hold()?;
                return Err(AdapterError::Rejected("the arm is moving".into()));
            }
            if changes { session.hold() } else { Ok(()) }
        })?;
        self.mode = mode;
        Ok(())
    }

    fn get_control_mode(&self) -> ControlMode {
        self.mode
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
        fill(positions, &self.recent()?.state().0.position);
        Ok(())
    }

    fn read_joint_velocities(&mut self, velocities: &mut [f64]) -> AdapterResult<bool> {
        fill(velocities, &self.recent()?.state().0.velocity);
        Ok(true)
    }

    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        self.with(|session| session.update(Duration::ZERO))?;
        let session = self.session.as_ref().ok_or(AdapterError::NotConnected)?;
        let (state, stamp) = session.state();
        *reading = JointReading {
            stamp: Some(stamp),
            device_ns: Some((state.time * 1e9) as u64),
            position: joints_of(&state.position),
            velocity: Some(joints_of(&state.velocity)),
            // No effort: motor currents are not torques.
            valid: session.positions_are_proven().then_some(true),
            commanded: session
                .enabled()
                .then(|| Commanded { position: joints_of(&state.target), velocity: joints_of(&state.target_velocity) }),
            speed_fraction: Some(session.speed_fraction()),
            ..JointReading::default()
        };
        Ok(())
    }

    /// State: the robot mode; mode: the safety mode.
    fn read_state(&mut self) -> AdapterResult<RobotState> {
        let (state, _) = self.recent()?.state();
        Ok(RobotState { state: state.robot_mode, mode: state.safety_mode })
    }

    fn read_error(&mut self) -> AdapterResult<(i32, String)> {
        Ok(self.recent()?.error()) // an empty text allocates nothing
    }

    fn read_enabled(&mut self) -> AdapterResult<bool> {
        Ok(self.recent()?.enabled())
    }

    // --- Motion ---

    fn write_joint_positions(&mut self, positions: &[f64], _velocity: f64) -> AdapterResult<()> {
        let joints = finite::<DOF>(positions)?;
        if self.mode != ControlMode::ServoPosition && self.session.is_some() {
            return Err(AdapterError::Rejected(format!("the arm is in {} mode", self.mode.name())));
        }
        self.with(|session| session.stream(Order::Servo(joints)))
    }

    fn write_joint_velocities(&mut self, velocities: &[f64]) -> AdapterResult<()> {
        let joints = finite::<DOF>(velocities)?;
        if self.mode != ControlMode::Velocity && self.session.is_some() {
            return Err(AdapterError::Rejected(format!("the arm is in {} mode", self.mode.name())));
        }
        self.with(|session| session.stream(Order::Speed(joints)))
    }

    fn write_stop(&mut self, _rest: &StopPoint) -> AdapterResult<Stop> {
        self.with(Session::stop)
    }

    fn write_enable(&mut self, enable: bool) -> AdapterResult<()> {
        if enable { self.activate() } else { self.with(Session::disable) }
    }

    fn write_clear_errors(&mut self) -> AdapterResult<()> {
        self.with(Session::clear_errors)
    }

    // --- Optional parts ---

    fn force_torque(&mut self) -> Option<&mut dyn ForceTorque> {
        if self.options.force_torque { Some(self) } else { None }
    }

    fn cartesian(&mut self) -> Option<&mut dyn Cartesian> {
        Some(self)
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
}

impl ForceTorque for UrAdapter {
    fn read_force_torque(&mut self) -> AdapterResult<Option<[f64; 6]>> {
        let session = self.recent()?;
        Ok(session.enabled().then_some(session.state().0.wrench))
    }
}

impl Cartesian for UrAdapter {
    fn read_cartesian_position(&mut self) -> AdapterResult<Option<ControllerPose>> {
        let session = self.recent()?;
        let (state, _) = session.state();
        let tool = session.rtde.has("tcp_offset").then(|| pose(&state.tcp_offset));
        Ok(Some(ControllerPose { tcp: pose(&state.tcp), tool, base: Some(Pose::default()) }))
    }
}

/// Returns the pose of a position [m] and a rotation vector [rad].
fn pose(&[x, y, z, a, b, c]: &[f64; 6]) -> Pose {
    let turn = UnitQuaternion::from_scaled_axis(Vector3::new(a, b, c));
    Pose::from(&Isometry3::from_parts(Translation3::new(x, y, z), turn))
}
