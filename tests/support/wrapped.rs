//! A mock adapter with a behaviour of its own where a test needs one.

use std::time::Duration;

use dimos::hardware::adapter::{AdapterResult, Gripper, ManipulatorAdapter, ManipulatorInfo, RobotState, Stop};
use dimos::hardware::arms::mock;
use dimos::hardware::check::Checked;
use dimos::hardware::registry::{AdapterSpec, AddressForm};
use dimos::joint::{ControlMode, JointLimits};
use dimos::testing::MockAdapter;

/// Hands everything on to a mock adapter.
#[derive(Clone)]
pub struct Wrapped {
    pub mock: MockAdapter,
    /// How long a gripper order takes.
    pub gripper_takes: Duration,
    /// Limits in the place of the mock's.
    pub limits: Option<JointLimits>,
}

impl Wrapped {
    /// An arm of 6 joints with a gripper, away from its zero pose.
    pub fn new() -> Self {
        let mock = MockAdapter::new(6).positions(&[0.1, 0.2, 0.3, 0.1, 0.2, 0.3]).gripper(0.02).connected(false);
        Self { mock, gripper_takes: Duration::ZERO, limits: None }
    }
}

/// A row of the adapter table for such an arm; `create` is missing.
pub const ROW: AdapterSpec = AdapterSpec {
    name: "wrapped",
    about: "an arm of a test",
    stale_after: Duration::from_secs(5),
    address: AddressForm { form: "TEXT", required: false, check: |address| Ok(address.to_owned()) },
    check: |config| Ok(Checked { limits: JointLimits::uniform(config.dof, 3.0, 2.0) }),
    ..mock::SPEC
};

impl ManipulatorAdapter for Wrapped {
    fn connect(&mut self) -> AdapterResult<()> {
        self.mock.connect()
    }
    fn disconnect(&mut self) {
        self.mock.disconnect();
    }
    fn is_connected(&self) -> bool {
        self.mock.is_connected()
    }
    fn activate(&mut self) -> AdapterResult<()> {
        self.mock.activate()
    }
    fn get_info(&self) -> ManipulatorInfo {
        self.mock.get_info()
    }
    fn get_dof(&self) -> usize {
        self.mock.get_dof()
    }
    fn get_limits(&mut self) -> AdapterResult<JointLimits> {
        let own = self.mock.get_limits()?;
        Ok(self.limits.clone().unwrap_or(own))
    }
    fn set_control_mode(&mut self, mode: ControlMode) -> AdapterResult<()> {
        self.mock.set_control_mode(mode)
    }
    fn get_control_mode(&self) -> ControlMode {
        self.mock.get_control_mode()
    }
    fn read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()> {
        self.mock.read_joint_positions(positions)
    }
    fn read_joint_velocities(&mut self, velocities: &mut [f64]) -> AdapterResult<bool> {
        self.mock.read_joint_velocities(velocities)
    }
    fn read_state(&mut self) -> AdapterResult<RobotState> {
        self.mock.read_state()
    }
    fn read_error(&mut self) -> AdapterResult<(i32, String)> {
        self.mock.read_error()
    }
    fn read_enabled(&mut self) -> AdapterResult<bool> {
        self.mock.read_enabled()
    }
    fn write_joint_positions(&mut self, positions: &[f64], velocity: f64) -> AdapterResult<()> {
        self.mock.write_joint_positions(positions, velocity)
    }
    fn write_stop(&mut self) -> AdapterResult<Stop> {
        self.mock.write_stop()
    }
    fn write_enable(&mut self, enable: bool) -> AdapterResult<()> {
        self.mock.write_enable(enable)
    }
    fn write_clear_errors(&mut self) -> AdapterResult<()> {
        self.mock.write_clear_errors()
    }
    fn gripper(&mut self) -> Option<&mut dyn Gripper> {
        Some(self)
    }
}

impl Gripper for Wrapped {
    fn read_gripper_position(&mut self) -> AdapterResult<Option<f64>> {
        self.mock.read_gripper_position()
    }
    fn write_gripper_position(&mut self, position: f64) -> AdapterResult<()> {
        std::thread::sleep(self.gripper_takes);
        self.mock.write_gripper_position(position)
    }
}
