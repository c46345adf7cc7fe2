//! The adapter of Franka arms: the adapter trait on one side, a [`Session`] with a controller on the other.
//!
//! Wire and here: rad, rad/s, Nm, m, kg. Poses are matrices on the wire, column by column.

use std::os::fd::BorrowedFd;

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion};

use super::ceiling::UserLimit;
use super::connect::connect;
use super::gripper::{FORCES, Hand, RANGE};
use super::protocol::{DOF, PORT};
use super::session::{LinkCounts, Session};
use super::{HOLDS_WHEN_DISABLED, MODES, NATIVE_RATE, Options, check};
use dimos_core::arm::{Commanded, ControllerPose, EffortKind, Load, Pose, StopPoint};
use dimos_core::joint::{ControlMode, JointLimits, joints_of};
use dimos_hardware::adapter::{
    AdapterError, AdapterResult, Cartesian, ForceTorque, Gripper, JointReading, ManipulatorAdapter, ManipulatorInfo,
    Payload, RobotState, Stop,
};
use dimos_hardware::adapter_util::{fill, finite};
use dimos_hardware::registry::AdapterConfig;
use dimos_hardware::transport::tcp::Endpoint;

/// How far from orthogonal the axes of a pose may be: single precision has 1e-6.
const NOT_RIGID: f64 = 1e-3;

/// A Franka arm behind its controller.
pub struct FrankaAdapter {
    address: Endpoint,
    pub(super) options: Options,
    pub(super) session: Option<Session>,
    hand: Option<Hand>,
    mode: ControlMode,
    /// Limits of the user.
    limits: [UserLimit; DOF],
}

impl FrankaAdapter {
    /// Creates an adapter for the controller at `config.address`. Does not connect.
    pub fn new(config: &AdapterConfig) -> AdapterResult<Self> {
        config.check(check)?;
        let address = config.parse_address(|text| Endpoint::parse(text, PORT))?;
        let (session, hand) = (None, None);
        let (mode, limits) = (ControlMode::ServoPosition, [UserLimit::NONE; DOF]);
        Ok(Self { address, options: config.options()?, session, hand, mode, limits })
    }

    /// Returns how states and answers fared since `connect`, and the controller's own success rate, 0 to 1: the share
    /// of the last 100 answers that came in time.
    pub fn link_quality(&self) -> Option<(LinkCounts, f64)> {
        self.session.as_ref().map(|session| (session.counts, session.state.success_rate))
    }

    /// Calls `act` with the connection; drops a broken one.
    pub(super) fn with<T>(&mut self, act: impl FnOnce(&mut Session) -> AdapterResult<T>) -> AdapterResult<T> {
        let result = act(self.session.as_mut().ok_or(AdapterError::NotConnected)?);
        if matches!(result, Err(AdapterError::Io(_))) {
            self.disconnect();
        }
        result
    }

    fn with_hand<T>(&mut self, act: impl FnOnce(&mut Hand) -> AdapterResult<T>) -> AdapterResult<T> {
        let result = act(self.hand.as_mut().ok_or(AdapterError::NotConnected)?);
        if matches!(result, Err(AdapterError::Io(_))) {
            self.disconnect();
        }
        result
    }

    fn connected(&self) -> AdapterResult<&Session> {
        self.session.as_ref().ok_or(AdapterError::NotConnected)
    }

    fn write(&mut self, mode: ControlMode, values: &[f64]) -> AdapterResult<()> {
        let joints = finite::<DOF>(values)?;
        if self.mode != mode && self.session.is_some() {
            return Err(AdapterError::Rejected(format!("the arm is in {} mode", self.mode.name())));
        }
        self.with(|session| session.stream(&joints))
    }
}

impl ManipulatorAdapter for FrankaAdapter {
    // --- Lifecycle ---

    fn connect(&mut self) -> AdapterResult<()> {
        self.disconnect();
        let mut session = connect(&self.address, &self.options)?;
        session.shaping.user = self.limits;
        self.hand = if self.options.gripper { Some(Hand::connect(&self.address, &self.options)?) } else { None };
        self.session = Some(session);
        Ok(())
    }

    fn disconnect(&mut self) {
        (self.session, self.hand) = (None, None);
    }

    fn is_connected(&self) -> bool {
        self.session.is_some()
    }

    fn activate(&mut self) -> AdapterResult<()> {
        let (options, velocity) = (self.options.clone(), self.mode == ControlMode::Velocity);
        self.with(|session| session.activate(&options, velocity))
    }

    /// Ends the motion. An arm that somebody else has taken over is left as it is.
    fn deactivate(&mut self, _rest: &StopPoint) -> AdapterResult<()> {
        match self.connected()?.foreign {
            Some(_) => Ok(()),
            None => self.with(Session::finish),
        }
    }

    // --- Identity ---

    fn get_info(&self) -> ManipulatorInfo {
        let interface = self.session.as_ref().map(|session| session.interface);
        ManipulatorInfo {
            vendor: "Franka Robotics".into(),
            model: self.options.model.name().into(),
            dof: DOF,
            firmware_version: interface.map(|interface| format!("FCI {}", interface.version())),
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

    /// Returns the limits of the model, narrowed by those that the robot reports.
    fn get_limits(&mut self) -> AdapterResult<JointLimits> {
        let (model, full) = (self.options.model, self.options.full_range);
        let mut limits = model.limits(full);
        let Some(session) = &self.session else { return Ok(limits) };
        let own = model.limits_of(&session.ranges, full);
        let narrow = |list: &mut Vec<f64>, own: &[f64], to: fn(f64, f64) -> f64| {
            list.iter_mut().zip(own).for_each(|(value, own)| *value = to(*value, *own));
        };
        narrow(&mut limits.position_lower, &own.position_lower, f64::max);
        narrow(&mut limits.position_upper, &own.position_upper, f64::min);
        narrow(&mut limits.velocity_max, &own.velocity_max, f64::min);
        narrow(&mut limits.acceleration_max, &own.acceleration_max, f64::min);
        Ok(limits)
    }

    fn set_limits(&mut self, limits: &JointLimits) {
        let of = |list: &[f64], joint: usize| list.get(joint).copied().unwrap_or(f64::INFINITY);
        self.limits = std::array::from_fn(|i| UserLimit {
            velocity: of(&limits.velocity_max, i),
            acceleration: of(&limits.acceleration_max, i),
        });
        if let Some(session) = &mut self.session {
            session.shaping.user = self.limits;
        }
    }

    // --- Mode ---

    fn set_control_mode(&mut self, mode: ControlMode) -> AdapterResult<()> {
        if !MODES.contains(&mode) {
            return Err(AdapterError::Unsupported);
        }
        let changes = mode != self.mode;
        self.with(|session| {
            session.update()?;
            if !changes || session.motion.is_none() {
                return Ok(());
            }
            if !session.at_rest() {
                return Err(AdapterError::Rejected("the arm is moving".into()));
            }
            session.finish()?;
            session.start(mode == ControlMode::Velocity)
        })?;
        self.mode = mode;
        Ok(())
    }

    fn get_control_mode(&self) -> ControlMode {
        self.mode
    }

    fn foreign_change(&self) -> Option<&'static str> {
        self.session.as_ref().and_then(|session| session.foreign)
    }

    // --- State ---

    fn state_fd(&self) -> Option<BorrowedFd<'_>> {
        self.session.as_ref().map(Session::fd)
    }

    fn read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()> {
        self.with(Session::update)?;
        fill(positions, &self.connected()?.state.q);
        Ok(())
    }

    fn read_joint_velocities(&mut self, velocities: &mut [f64]) -> AdapterResult<bool> {
        fill(velocities, &self.connected()?.state.dq);
        Ok(true)
    }

    fn read_joint_efforts(&mut self, efforts: &mut [f64]) -> AdapterResult<bool> {
        fill(efforts, &self.connected()?.state.tau);
        Ok(true)
    }

    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        self.with(Session::update)?;
        let session = self.connected()?;
        let state = &session.state;
        *reading = JointReading {
            stamp: Some(session.fresh_at),
            device_ns: Some(state.id.saturating_mul(1_000_000)),
            position: joints_of(&state.q),
            velocity: Some(joints_of(&state.dq)),
            effort: Some(joints_of(&state.tau)),
            effort_kind: EffortKind::Measured,
            valid: session.positions_are_proven().then_some(true),
            commanded: Some(Commanded { position: joints_of(&state.q_d), velocity: joints_of(&state.dq_d) }),
            ..JointReading::default()
        };
        Ok(())
    }

    /// State: what the robot does; mode: its motion generator.
    fn read_state(&mut self) -> AdapterResult<RobotState> {
        let state = &self.connected()?.state;
        Ok(RobotState { state: state.mode.into(), mode: state.generator.into() })
    }

    fn read_error(&mut self) -> AdapterResult<(i32, String)> {
        Ok(self.connected()?.error()) // an empty text allocates nothing
    }

    fn read_enabled(&mut self) -> AdapterResult<bool> {
        Ok(self.connected()?.enabled())
    }

    // --- Motion ---

    fn write_joint_positions(&mut self, positions: &[f64], _velocity: f64) -> AdapterResult<()> {
        self.write(ControlMode::ServoPosition, positions)
    }

    fn write_joint_velocities(&mut self, velocities: &[f64]) -> AdapterResult<()> {
        self.write(ControlMode::Velocity, velocities)
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

    fn gripper(&mut self) -> Option<&mut dyn Gripper> {
        if self.hand.is_some() { Some(self) } else { None }
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
}

impl Gripper for FrankaAdapter {
    fn read_gripper_position(&mut self) -> AdapterResult<Option<f64>> {
        self.with_hand(Hand::width)
    }

    fn write_gripper_position(&mut self, position: f64) -> AdapterResult<()> {
        self.with_hand(|hand| hand.move_to(position, None))
    }

    fn get_gripper_range(&mut self) -> Option<(f64, f64)> {
        Some(RANGE)
    }

    fn read_gripper_holds(&mut self) -> AdapterResult<Option<bool>> {
        self.with_hand(|hand| Ok(hand.grasps()))
    }

    fn has_gripper_speed(&self) -> bool {
        true
    }

    fn set_gripper_speed(&mut self, fraction: Option<f64>) {
        let _ = self.with_hand(|hand| {
            hand.set_speed(fraction);
            Ok(())
        });
    }

    fn get_gripper_force_range(&mut self) -> Option<(f64, f64)> {
        Some(FORCES)
    }

    fn write_gripper_position_with_force(&mut self, position: f64, force: f64) -> AdapterResult<()> {
        self.with_hand(|hand| hand.move_to(position, Some(force)))
    }
}

impl ForceTorque for FrankaAdapter {
    /// The controller's estimate from the joint torques, in the base frame.
    fn read_force_torque(&mut self) -> AdapterResult<Option<[f64; 6]>> {
        Ok(Some(self.connected()?.state.force))
    }
}

impl Cartesian for FrankaAdapter {
    fn read_cartesian_position(&mut self) -> AdapterResult<Option<ControllerPose>> {
        let state = &self.connected()?.state;
        let stated = |tcp| ControllerPose { tcp, tool: pose(&state.end_effector), base: Some(Pose::default()) };
        Ok(pose(&state.pose).map(stated))
    }
}

/// Returns the pose that a matrix of the wire has, column by column; `None` for one that is no pose: a controller that
/// has not computed it sends zeros.
pub(super) fn pose(&[a, b, c, _, d, e, f, _, g, h, i, _, x, y, z, _]: &[f64; 16]) -> Option<Pose> {
    let matrix = Matrix3::new(a, d, g, b, e, h, c, f, i);
    let proper = (matrix * matrix.transpose() - Matrix3::identity()).amax() < NOT_RIGID && matrix.determinant() > 0.0;
    let turn = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(matrix));
    (proper && [x, y, z].iter().all(|v| v.is_finite()))
        .then(|| Pose::from(&Isometry3::from_parts(Translation3::new(x, y, z), turn)))
}

impl Payload for FrankaAdapter {
    fn read_payload(&mut self) -> AdapterResult<Option<Load>> {
        let state = &self.connected()?.state;
        Ok(Some(together(&state.tool, &state.load)))
    }

    fn write_payload(&mut self, load: &Load) -> AdapterResult<()> {
        let tool = self.connected()?.state.tool;
        let rest = load.without(&tool).ok_or_else(|| {
            AdapterError::Rejected(format!(
                "the controller already counts {:.3} kg of the end effector that is set up in Desk, and a payload of {:.3} kg \
                 is to be all of tool and workpiece\nhint: give both together, or set up no end effector in Desk",
                tool.mass, load.mass
            ))
        })?;
        self.with(|session| session.set_load(&rest))
    }
}

/// Returns all that the controller carries: the end effector of Desk and the load. Without the inertia of one,
/// that of both is unknown.
fn together(tool: &Load, load: &Load) -> Load {
    let both = tool.plus(load);
    let unstated = |body: &Load| body.mass > 0.0 && body.inertia.iter().all(|v| *v == 0.0);
    let unknown = unstated(tool) || unstated(load);
    if unknown { Load { inertia: [0.0; 6], ..both } } else { both }
}
