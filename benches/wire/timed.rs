//! An adapter that wraps another one and records when commands were written and states were read.

use std::sync::{Arc, Mutex};

use dimos::arm::Setpoint;
use dimos::clock::{Clock, MonotonicClock};
use dimos::hardware::adapter::{
    AdapterResult, Cartesian, ForceTorque, Gripper, JointReading, ManipulatorAdapter, ManipulatorInfo, RobotState, Stop,
};

use crate::delegate::delegate;

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
    /// From the time of a setpoint until it was written.
    pub sent: Delays,
    /// From the time stamp in a state's first joint (a microradian each, as in a report) until it was read.
    pub arrived: Delays,
}

fn note(delays: &Delays, delay: f64) {
    if let Ok(mut delays) = delays.lock()
        && delays.len() < delays.capacity()
    {
        delays.push(delay);
    }
}

impl ManipulatorAdapter for Timed {
    delegate!(
        inner: connect, disconnect, is_connected, activate, deactivate, get_info, get_dof, get_limits,
        set_control_mode, get_control_mode, state_fd, read_joint_positions, read_state, read_error, read_enabled,
        gripper, force_torque, cartesian, write_joint_positions, write_stop, write_enable, write_clear_errors
    );

    fn write_setpoint(&mut self, setpoint: &Setpoint) -> AdapterResult<()> {
        let result = self.inner.write_setpoint(setpoint);
        if result.is_ok() {
            note(&self.sent, MonotonicClock.now().seconds_since(setpoint.at) * 1e6);
        }
        result
    }

    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        let before = reading.stamp;
        let result = self.inner.read_joints(reading);
        if result.is_ok() && reading.stamp != before {
            note(&self.arrived, since(reading.position[0] * 1e-3));
        }
        result
    }
}
