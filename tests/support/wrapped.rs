//! A mock adapter with a behaviour of its own where a test needs one.

use std::time::Duration;

use dimos::arms::mock;
use dimos::hardware::adapter::{AdapterResult, Gripper, ManipulatorAdapter, ManipulatorInfo, RobotState, Stop};
use dimos::hardware::check::Checked;
use dimos::hardware::registry::{AdapterSpec, AddressForm};
use dimos::joint::JointLimits;
use dimos::testing::MockAdapter;

use super::delegate::delegate;

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
    droop: 0.0,
    relief: 0.0,
    outside: 0.02,
    gap_tolerance: Duration::ZERO,
    after_gap: dimos::arm::AfterGap::RestsAtSetpoint,
    topology: dimos::arm::Topology::MultiTurn,
    address: AddressForm { form: "TEXT", required: false, check: |address| Ok(address.to_owned()) },
    check: |config| Ok(Checked::new(JointLimits::uniform(config.dof, 3.0, 2.0))),
    ..mock::SPEC
};

impl ManipulatorAdapter for Wrapped {
    delegate!(
        mock: connect, disconnect, is_connected, activate, get_info, get_dof, set_control_mode, get_control_mode,
        read_joint_positions, read_joint_velocities, read_state, read_error, read_enabled, write_joint_positions,
        write_stop, write_enable, write_clear_errors
    );

    fn get_limits(&mut self) -> AdapterResult<JointLimits> {
        let own = self.mock.get_limits()?;
        Ok(self.limits.clone().unwrap_or(own))
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
