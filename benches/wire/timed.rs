//! An adapter that wraps another one and records when commands were written and states were read.

use std::os::fd::BorrowedFd;
use std::sync::{Arc, Mutex};

use dimos::clock::{Clock, MonotonicClock};
use dimos::hardware::adapter::{
    AdapterResult, Cartesian, ForceTorque, Gripper, JointReading, ManipulatorAdapter, ManipulatorInfo, RobotState, Stop,
};
use dimos::joint::{ControlMode, JointLimits};

/// Returns a time stamp as a joint position: microseconds of the current second, a nanoradian each.
pub fn moment() -> f64 {
    (MonotonicClock.now().0 / 1_000 % 1_000_000) as f64 * 1e-9
}

/// Returns the time since a [`moment`] [µs].
pub fn since(moment: f64) -> f64 {
    let then = (moment * 1e9).round();
    let now = (MonotonicClock.now().0 / 1_000 % 1_000_000) as f64;
    (now - then).rem_euclid(1e6)
}

/// Delays [µs]; reserved in advance, so that recording does not allocate.
pub type Delays = Arc<Mutex<Vec<f64>>>;

/// The wrapped adapter.
pub struct Timed {
    pub inner: Box<dyn ManipulatorAdapter>,
    /// From the time stamp in a command's first joint until it was written.
    pub sent: Delays,
    /// From the time stamp in a state's first joint (a microradian each, as in a report) until it was read.
    pub arrived: Delays,
}

fn note(delays: &Delays, moment: f64) {
    if let Ok(mut delays) = delays.lock()
        && delays.len() < delays.capacity()
    {
        delays.push(since(moment));
    }
}

impl ManipulatorAdapter for Timed {
    fn write_joint_positions(&mut self, positions: &[f64], velocity: f64) -> AdapterResult<()> {
        let result = self.inner.write_joint_positions(positions, velocity);
        if let (Ok(()), Some(then)) = (&result, positions.first()) {
            note(&self.sent, *then);
        }
        result
    }
    fn connect(&mut self) -> AdapterResult<()> {
        self.inner.connect()
    }
    fn disconnect(&mut self) {
        self.inner.disconnect();
    }
    fn is_connected(&self) -> bool {
        self.inner.is_connected()
    }
    fn activate(&mut self) -> AdapterResult<()> {
        self.inner.activate()
    }
    fn deactivate(&mut self) -> AdapterResult<()> {
        self.inner.deactivate()
    }
    fn get_info(&self) -> ManipulatorInfo {
        self.inner.get_info()
    }
    fn get_dof(&self) -> usize {
        self.inner.get_dof()
    }
    fn get_limits(&mut self) -> AdapterResult<JointLimits> {
        self.inner.get_limits()
    }
    fn set_control_mode(&mut self, mode: ControlMode) -> AdapterResult<()> {
        self.inner.set_control_mode(mode)
    }
    fn get_control_mode(&self) -> ControlMode {
        self.inner.get_control_mode()
    }
    fn state_fd(&self) -> Option<BorrowedFd<'_>> {
        self.inner.state_fd()
    }
    fn read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()> {
        self.inner.read_joint_positions(positions)
    }
    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        let before = reading.stamp;
        let result = self.inner.read_joints(reading);
        if result.is_ok() && reading.stamp != before {
            note(&self.arrived, reading.position[0] * 1e-3);
        }
        result
    }
    fn read_state(&mut self) -> AdapterResult<RobotState> {
        self.inner.read_state()
    }
    fn read_error(&mut self) -> AdapterResult<(i32, String)> {
        self.inner.read_error()
    }
    fn read_enabled(&mut self) -> AdapterResult<bool> {
        self.inner.read_enabled()
    }
    fn gripper(&mut self) -> Option<&mut dyn Gripper> {
        self.inner.gripper()
    }
    fn force_torque(&mut self) -> Option<&mut dyn ForceTorque> {
        self.inner.force_torque()
    }
    fn cartesian(&mut self) -> Option<&mut dyn Cartesian> {
        self.inner.cartesian()
    }
    fn write_stop(&mut self) -> AdapterResult<Stop> {
        self.inner.write_stop()
    }
    fn write_enable(&mut self, enable: bool) -> AdapterResult<()> {
        self.inner.write_enable(enable)
    }
    fn write_clear_errors(&mut self) -> AdapterResult<()> {
        self.inner.write_clear_errors()
    }
}
