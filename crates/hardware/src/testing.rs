//! For the unit tests of programs that use this crate: a mock adapter with scripted answers that records its calls.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard};

use crate::adapter::{
    AdapterError, AdapterResult, Cartesian, ForceTorque, Gripper, ManipulatorAdapter, ManipulatorInfo, RobotState, Stop,
};
use crate::sim::reach::Chain;
use dimos_core::arm::{ControllerPose, Pose, StopPoint};
use dimos_core::joint::{ControlMode, JointLimits};
use dimos_core::pose::{from_xyz_rpy, to_xyz_rpy};
use dimos_core::sync::lock;

/// Returns whether the inverse of a chain leads from `start` back to the pose of `there` [rad], and fails for a pose
/// out of reach.
pub fn leads_back<const N: usize>(chain: &impl Chain, start: [f64; N], there: [f64; N]) -> bool {
    let (xyz, rpy) = to_xyz_rpy(&chain.forward(&there));
    let goal = from_xyz_rpy(xyz, rpy);
    let near = |found: [f64; N]| (chain.forward(&found).translation.vector - goal.translation.vector).norm() < 1e-5;
    chain.inverse(&goal, &start).is_some_and(near)
        && chain.inverse(&from_xyz_rpy([5.0, 0.0, 0.0], [0.0; 3]), &start).is_none()
}

/// A call to an adapter, with its arguments in SI units.
#[derive(Debug, Clone, PartialEq)]
pub enum Call {
    /// A method without arguments that matter: every read, `connect`, `activate`, `write_stop` …
    Method(&'static str),
    /// `set_control_mode`
    SetControlMode(ControlMode),
    /// `write_joint_positions`: positions [rad], fraction of the top speed.
    WriteJointPositions(Vec<f64>, f64),
    /// `write_joint_velocities` [rad/s]
    WriteJointVelocities(Vec<f64>),
    /// `write_enable`
    WriteEnable(bool),
    /// `write_cartesian_position`: pose, fraction of the top speed.
    WriteCartesianPosition(Pose, f64),
    /// `write_gripper_position` [m]
    WriteGripperPosition(f64),
    /// `write_gripper_position_with_force` [m, N]
    WriteGripperPositionWithForce(f64, f64),
}

impl Call {
    /// The name of the method.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Method(name) => name,
            Self::SetControlMode(_) => "set_control_mode",
            Self::WriteJointPositions(..) => "write_joint_positions",
            Self::WriteJointVelocities(_) => "write_joint_velocities",
            Self::WriteEnable(_) => "write_enable",
            Self::WriteCartesianPosition(..) => "write_cartesian_position",
            Self::WriteGripperPosition(_) => "write_gripper_position",
            Self::WriteGripperPositionWithForce(..) => "write_gripper_position_with_force",
        }
    }
}

/// The methods that can be made to fail.
const METHODS: &[&str] = &[
    "connect",
    "activate",
    "deactivate",
    "get_limits",
    "set_control_mode",
    "read_joint_positions",
    "read_joint_velocities",
    "read_joint_efforts",
    "read_state",
    "read_error",
    "read_enabled",
    "write_joint_positions",
    "write_joint_velocities",
    "write_stop",
    "write_enable",
    "write_clear_errors",
    "read_cartesian_position",
    "write_cartesian_position",
    "read_gripper_position",
    "write_gripper_position",
    "write_gripper_position_with_force",
    "read_gripper_force",
    "read_force_torque",
];

struct Shared {
    dof: usize,
    connected: bool,
    enabled: bool,
    mode: ControlMode,
    positions: Vec<f64>,
    velocities: Option<Vec<f64>>,
    efforts: Option<Vec<f64>>,
    error: (i32, String),
    pose: Option<Pose>,
    gripper: Option<f64>,
    wrench: Option<[f64; 6]>,
    serial: Option<String>,
    failures: VecDeque<(&'static str, AdapterError)>,
    calls: Vec<Call>,
}

/// A mock of [`ManipulatorAdapter`]: scripted answers, and a record of the calls.
///
/// Nothing moves: positions stay what they were set to, whatever is written. (For an arm that moves use the adapter
/// `mock`.) Clones share everything, so a test keeps one and passes the other on.
///
/// ```
/// use dimos_core::arm::StopPoint;
/// use dimos_hardware::adapter::{AdapterError, ManipulatorAdapter};
/// use dimos_hardware::testing::{Call, MockAdapter};
///
/// let mock = MockAdapter::new(6).positions(&[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]);
/// let mut adapter: Box<dyn ManipulatorAdapter> = Box::new(mock.clone());
///
/// let mut positions = [0.0; 6];
/// adapter.read_joint_positions(&mut positions).unwrap();
/// assert_eq!(positions, [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]);
///
/// adapter.write_joint_positions(&[0.0; 6], 0.5).unwrap();
/// assert_eq!(mock.calls().last(), Some(&Call::WriteJointPositions(vec![0.0; 6], 0.5)));
///
/// mock.fail("write_stop", AdapterError::Timeout("no answer".into()));
/// assert!(adapter.write_stop(&StopPoint::default()).is_err());
/// assert!(adapter.write_stop(&StopPoint::default()).is_ok(), "it fails once");
/// ```
#[derive(Clone)]
pub struct MockAdapter(Arc<Mutex<Shared>>);

impl MockAdapter {
    /// An adapter of `dof` joints: connected, enabled, all joints at zero and at rest, no error; no efforts, pose,
    /// gripper or force/torque sensor.
    pub fn new(dof: usize) -> Self {
        Self(Arc::new(Mutex::new(Shared {
            dof,
            connected: true,
            enabled: true,
            mode: ControlMode::Position,
            positions: vec![0.0; dof],
            velocities: Some(vec![0.0; dof]),
            efforts: None,
            error: (0, String::new()),
            pose: None,
            gripper: None,
            wrench: None,
            serial: None,
            failures: VecDeque::new(),
            calls: Vec::new(),
        })))
    }

    /// Answers of `read_joint_positions` [rad].
    pub fn positions(self, positions: &[f64]) -> Self {
        self.lock().positions = positions.to_vec();
        self
    }

    /// Its serial number, from the next `connect` on.
    pub fn serial(self, serial: &str) -> Self {
        self.lock().serial = Some(serial.to_owned());
        self
    }

    /// Answers of `read_joint_velocities` [rad/s]; `None`: not supported.
    pub fn velocities(self, velocities: Option<&[f64]>) -> Self {
        self.lock().velocities = velocities.map(<[f64]>::to_vec);
        self
    }

    /// Answers of `read_joint_efforts` [Nm]; `None`: not supported.
    pub fn efforts(self, efforts: Option<&[f64]>) -> Self {
        self.lock().efforts = efforts.map(<[f64]>::to_vec);
        self
    }

    /// Whether it is connected before `connect` is called.
    pub fn connected(self, connected: bool) -> Self {
        self.lock().connected = connected;
        self
    }

    /// Whether its motors are enabled before `write_enable` is called.
    pub fn enabled(self, enabled: bool) -> Self {
        self.lock().enabled = enabled;
        self
    }

    /// Answers of `read_error`, until errors are cleared.
    pub fn error(self, code: i32, text: &str) -> Self {
        self.lock().error = (code, text.to_owned());
        self
    }

    /// Gives it kinematics, which answer with this pose.
    pub fn pose(self, pose: Pose) -> Self {
        self.lock().pose = Some(pose);
        self
    }

    /// Gives it a gripper at this opening [m].
    pub fn gripper(self, opening: f64) -> Self {
        self.lock().gripper = Some(opening);
        self
    }

    /// Gives it a force/torque sensor, which answers with this [N, N, N, Nm, Nm, Nm].
    pub fn force_torque(self, wrench: [f64; 6]) -> Self {
        self.lock().wrench = Some(wrench);
        self
    }

    /// Makes the next call of a method fail; several failures of one method happen in order.
    ///
    /// # Panics
    /// When an adapter has no fallible method of that name.
    pub fn fail(&self, method: &str, error: AdapterError) {
        let known = METHODS.iter().find(|known| **known == method);
        assert!(known.is_some(), "no method {method:?} of an adapter can fail");
        self.lock().failures.extend(known.map(|name| (*name, error)));
    }

    /// Returns all calls so far, in order, except `is_connected` and the infallible `get_…` methods.
    pub fn calls(&self) -> Vec<Call> {
        self.lock().calls.clone()
    }

    /// Forgets the calls so far.
    pub fn clear_calls(&self) {
        self.lock().calls.clear();
    }

    fn lock(&self) -> MutexGuard<'_, Shared> {
        lock(&self.0)
    }

    /// Records a call; fails if the script says so.
    fn called(&self, call: Call) -> AdapterResult<MutexGuard<'_, Shared>> {
        let mut shared = self.lock();
        let name = call.name();
        shared.calls.push(call);
        match shared.failures.iter().position(|failure| failure.0 == name) {
            Some(i) => Err(shared.failures.remove(i).map_or(AdapterError::NotConnected, |failure| failure.1)),
            None => Ok(shared),
        }
    }

    fn asked(&self, name: &'static str) -> AdapterResult<MutexGuard<'_, Shared>> {
        self.called(Call::Method(name))
    }
}

fn fill(out: &mut [f64], values: &[f64]) {
    out.iter_mut().zip(values).for_each(|(to, value)| *to = *value);
}

impl ManipulatorAdapter for MockAdapter {
    fn connect(&mut self) -> AdapterResult<()> {
        self.asked("connect")?.connected = true;
        Ok(())
    }

    fn disconnect(&mut self) {
        let mut shared = self.lock();
        shared.calls.push(Call::Method("disconnect"));
        shared.connected = false;
    }

    fn is_connected(&self) -> bool {
        self.lock().connected
    }

    fn activate(&mut self) -> AdapterResult<()> {
        self.asked("activate")?.enabled = true;
        Ok(())
    }

    fn deactivate(&mut self, _rest: &StopPoint) -> AdapterResult<()> {
        self.asked("deactivate").map(|_| ())
    }

    fn get_info(&self) -> ManipulatorInfo {
        ManipulatorInfo {
            vendor: "dimos".into(),
            model: "test double".into(),
            dof: self.get_dof(),
            firmware_version: None,
            serial_number: self.lock().serial.clone(),
            native_rate: 1000.0,
            modes: ControlMode::ALL,
            holds_when_disabled: true,
            whole_state_at_once: true,
        }
    }

    fn get_dof(&self) -> usize {
        self.lock().dof
    }

    fn get_limits(&mut self) -> AdapterResult<JointLimits> {
        let dof = self.asked("get_limits")?.dof;
        Ok(JointLimits::uniform(dof, std::f64::consts::PI, std::f64::consts::PI))
    }

    fn set_control_mode(&mut self, mode: ControlMode) -> AdapterResult<()> {
        self.called(Call::SetControlMode(mode))?.mode = mode;
        Ok(())
    }

    fn get_control_mode(&self) -> ControlMode {
        self.lock().mode
    }

    fn read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()> {
        fill(positions, &self.asked("read_joint_positions")?.positions);
        Ok(())
    }

    fn read_joint_velocities(&mut self, velocities: &mut [f64]) -> AdapterResult<bool> {
        let shared = self.asked("read_joint_velocities")?;
        fill(velocities, shared.velocities.as_deref().unwrap_or_default());
        Ok(shared.velocities.is_some())
    }

    fn read_joint_efforts(&mut self, efforts: &mut [f64]) -> AdapterResult<bool> {
        let shared = self.asked("read_joint_efforts")?;
        fill(efforts, shared.efforts.as_deref().unwrap_or_default());
        Ok(shared.efforts.is_some())
    }

    fn read_state(&mut self) -> AdapterResult<RobotState> {
        self.asked("read_state").map(|_| RobotState::default())
    }

    fn read_error(&mut self) -> AdapterResult<(i32, String)> {
        Ok(self.asked("read_error")?.error.clone())
    }

    fn read_enabled(&mut self) -> AdapterResult<bool> {
        Ok(self.asked("read_enabled")?.enabled)
    }

    fn write_joint_positions(&mut self, positions: &[f64], velocity: f64) -> AdapterResult<()> {
        self.called(Call::WriteJointPositions(positions.to_vec(), velocity)).map(|_| ())
    }

    fn write_joint_velocities(&mut self, velocities: &[f64]) -> AdapterResult<()> {
        self.called(Call::WriteJointVelocities(velocities.to_vec())).map(|_| ())
    }

    fn write_stop(&mut self, _rest: &StopPoint) -> AdapterResult<Stop> {
        self.asked("write_stop").map(|_| Stop::Confirmed)
    }

    fn write_enable(&mut self, enable: bool) -> AdapterResult<()> {
        self.called(Call::WriteEnable(enable))?.enabled = enable;
        Ok(())
    }

    fn write_clear_errors(&mut self) -> AdapterResult<()> {
        self.asked("write_clear_errors")?.error = (0, String::new());
        Ok(())
    }

    fn gripper(&mut self) -> Option<&mut dyn Gripper> {
        if self.lock().gripper.is_some() { Some(self) } else { None }
    }

    fn force_torque(&mut self) -> Option<&mut dyn ForceTorque> {
        if self.lock().wrench.is_some() { Some(self) } else { None }
    }

    fn cartesian(&mut self) -> Option<&mut dyn Cartesian> {
        if self.lock().pose.is_some() { Some(self) } else { None }
    }
}

impl Gripper for MockAdapter {
    fn read_gripper_position(&mut self) -> AdapterResult<Option<f64>> {
        Ok(self.asked("read_gripper_position")?.gripper)
    }

    fn write_gripper_position(&mut self, position: f64) -> AdapterResult<()> {
        self.called(Call::WriteGripperPosition(position)).map(|_| ())
    }

    /// 0 to 40 N.
    fn get_gripper_force_range(&mut self) -> Option<(f64, f64)> {
        Some((0.0, 40.0))
    }

    fn write_gripper_position_with_force(&mut self, position: f64, force: f64) -> AdapterResult<()> {
        self.called(Call::WriteGripperPositionWithForce(position, force)).map(|_| ())
    }

    fn read_gripper_force(&mut self) -> AdapterResult<Option<f64>> {
        Ok(self.asked("read_gripper_force")?.gripper.map(|_| 0.0))
    }
}

impl ForceTorque for MockAdapter {
    fn read_force_torque(&mut self) -> AdapterResult<Option<[f64; 6]>> {
        Ok(self.asked("read_force_torque")?.wrench)
    }
}

impl Cartesian for MockAdapter {
    fn read_cartesian_position(&mut self) -> AdapterResult<Option<ControllerPose>> {
        Ok(self.asked("read_cartesian_position")?.pose.map(ControllerPose::of_flange))
    }

    fn write_cartesian_position(&mut self, pose: &Pose, velocity: f64) -> AdapterResult<()> {
        self.called(Call::WriteCartesianPosition(*pose, velocity)).map(|_| ())
    }
}
