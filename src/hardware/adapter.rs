//! The protocol between this program and an arm: [`ManipulatorAdapter`], the guide's interface in Rust.
//!
//! Everything that crosses it is in SI units: rad, rad/s, Nm, m, N. A new arm implements the methods without a
//! default body and those of the rest that its device can do; the defaults say "no" in the agreed way, so the
//! absence of a feature is never an error.
//!
//! A device either answers when it is asked, or sends its state by itself. For the second kind
//! [`ManipulatorAdapter::state_fd`] names the descriptor on which the state arrives: the device thread then reads when
//! something has come, and the age of the state is the device's doing alone.

use std::os::fd::BorrowedFd;
use std::time::Duration;

use crate::arm::Pose;
use crate::clock::Mono;
use crate::joint::{ControlMode, JointLimits, Joints, MAX_DOF};

/// Why an adapter could not do what it was asked.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum AdapterError {
    /// The connection failed or broke.
    #[error("{0}")]
    Io(String),
    /// The device did not answer in time.
    #[error("{0}")]
    Timeout(String),
    /// The device answered what it should not.
    #[error("{0}")]
    Protocol(String),
    /// The device is in error.
    #[error("fault {code}: {text}")]
    Fault {
        /// The device's own code.
        code: i32,
        /// What the code means.
        text: String,
    },
    /// The device refused a command.
    #[error("{0}")]
    Rejected(String),
    /// Two setpoints are on their way and not acknowledged: this one was not sent. No failure of the device.
    #[error("two setpoints are still unacknowledged")]
    Busy,
    /// The device has no such feature.
    #[error("not supported by this arm")]
    Unsupported,
    /// Called before `connect` or after the connection was lost.
    #[error("not connected")]
    NotConnected,
}

/// Result of an adapter call.
pub type AdapterResult<T> = Result<T, AdapterError>;

/// What an arm is.
#[derive(Debug, Clone, PartialEq)]
pub struct ManipulatorInfo {
    /// Who made it.
    pub vendor: String,
    /// Which model it is.
    pub model: String,
    /// Number of joints.
    pub dof: usize,
    /// Firmware version, where the device tells.
    pub firmware_version: Option<String>,
    /// Serial number, where the device tells.
    pub serial_number: Option<String>,
    /// How often the device can deliver its state [Hz].
    pub native_rate: f64,
    /// The modes that `set_control_mode` accepts.
    pub modes: &'static [ControlMode],
    /// Whether the arm keeps its pose when its motors are disabled (brakes), or falls.
    pub holds_when_disabled: bool,
    /// Whether `read_joints` brings the whole state, so that the other reads answer from memory. Otherwise each of
    /// them costs a round trip, and they are made in turns, one a cycle.
    pub whole_state_at_once: bool,
}

/// Joint positions, velocities and efforts of one moment, read in one go.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct JointReading {
    /// When the device measured, where it tells (translated to the monotonic clock).
    pub stamp: Option<Mono>,
    /// Joint positions [rad].
    pub position: Joints,
    /// Joint velocities [rad/s], where the device has them.
    pub velocity: Option<Joints>,
    /// Joint torques [Nm], where the device has them.
    pub effort: Option<Joints>,
    /// The device's own sign that the positions are measured: `Some(true)` confirms them, `Some(false)` says that they
    /// are not measured yet, `None`: the device has no such sign. Without a confirmation, exactly zero on all joints
    /// counts as missing when the motors are to be enabled.
    pub valid: Option<bool>,
}

/// The device's own state words, as it reports them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RobotState {
    /// The device's state code.
    pub state: i32,
    /// The device's mode code.
    pub mode: i32,
}

/// What `write_stop` achieved.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stop {
    /// The device answered that it stops.
    Confirmed,
    /// The stop was sent; the device has no way to confirm it.
    Sent,
}

/// An arm, as the rest of the program sees it. One device thread owns it and makes all calls.
///
/// Methods that fill a slice get one of length dof and must not allocate: they run every cycle.
pub trait ManipulatorAdapter: Send {
    // --- Lifecycle ---

    /// Connects and verifies that the right device is alive. Moves nothing, enables nothing.
    fn connect(&mut self) -> AdapterResult<()>;
    /// Ends the connection. Never fails; harmless when not connected.
    fn disconnect(&mut self);
    /// Whether the connection is up, as far as is known without asking the device.
    fn is_connected(&self) -> bool;
    /// Prepares for commanded motion: enables the servos and leaves the arm where it is.
    fn activate(&mut self) -> AdapterResult<()> {
        self.write_enable(true)
    }
    /// Ends commanded motion gracefully, before `disconnect`. Motor power stays as it is.
    fn deactivate(&mut self) -> AdapterResult<()> {
        self.write_stop().map(|_| ())
    }

    // --- What it is ---

    /// Vendor, model, dof, versions, rate, modes.
    fn get_info(&self) -> ManipulatorInfo;
    /// Number of joints.
    fn get_dof(&self) -> usize;
    /// Joint limits, known or asked of the device.
    fn get_limits(&mut self) -> AdapterResult<JointLimits>;

    // --- Mode ---

    /// Brings the device into a mode; `Unsupported` for one that it lacks.
    fn set_control_mode(&mut self, mode: ControlMode) -> AdapterResult<()>;
    /// The mode the device is in, verified where it can tell.
    fn get_control_mode(&self) -> ControlMode;

    /// What another client of the device, or a person at its panel, changed since the last `activate` or
    /// `set_control_mode`: a stop, a pause, another mode, motors off. `None`: nothing, or the device itself is the
    /// cause (`read_error`). An adapter never undoes such a change by itself. Must not allocate.
    fn foreign_change(&self) -> Option<&'static str> {
        None
    }

    // --- State ---

    /// For a device that sends its state by itself: what becomes readable when something has arrived. The device
    /// thread then calls [`ManipulatorAdapter::read_joints`] at once, which must take up all that has arrived without
    /// waiting, and answer with the newest state and its own `stamp`: the same as before when nothing newer has come.
    /// After a silence that a living device never keeps it answers with an error. `None`: the device is asked.
    fn state_fd(&self) -> Option<BorrowedFd<'_>> {
        None
    }
    /// Fills in the joint positions [rad].
    fn read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()>;
    /// Fills in the joint velocities [rad/s]; `false` when the device has none (the coordinator estimates them).
    fn read_joint_velocities(&mut self, _velocities: &mut [f64]) -> AdapterResult<bool> {
        Ok(false)
    }
    /// Fills in the joint torques [Nm]; `false` when the device has none.
    fn read_joint_efforts(&mut self, _efforts: &mut [f64]) -> AdapterResult<bool> {
        Ok(false)
    }
    /// All three at once. An arm that gets them in one packet overrides this.
    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        let dof = self.get_dof().min(MAX_DOF);
        let mut buffer = [0.0; MAX_DOF];
        let slice = buffer.get_mut(..dof).unwrap_or_default();
        reading.stamp = None;
        self.read_joint_positions(slice)?;
        reading.position = buffer;
        let mut buffer = [0.0; MAX_DOF];
        let slice = buffer.get_mut(..dof).unwrap_or_default();
        reading.velocity = self.read_joint_velocities(slice)?.then_some(buffer);
        let mut buffer = [0.0; MAX_DOF];
        let slice = buffer.get_mut(..dof).unwrap_or_default();
        reading.effort = self.read_joint_efforts(slice)?.then_some(buffer);
        Ok(())
    }
    /// The device's own state and mode codes.
    fn read_state(&mut self) -> AdapterResult<RobotState>;
    /// The device's error: code and text; `(0, "")` when there is none. The text is only built when the code is
    /// not 0, so a healthy cycle allocates nothing.
    fn read_error(&mut self) -> AdapterResult<(i32, String)>;
    /// Whether the servos are enabled.
    fn read_enabled(&mut self) -> AdapterResult<bool>;

    // --- Motion ---

    /// Commands joint positions [rad]. `velocity` is a fraction of the device's top speed (0–1], used where the
    /// device plans the way itself.
    fn write_joint_positions(&mut self, positions: &[f64], velocity: f64) -> AdapterResult<()>;
    /// Commands joint velocities [rad/s].
    fn write_joint_velocities(&mut self, _velocities: &[f64]) -> AdapterResult<()> {
        Err(AdapterError::Unsupported)
    }
    /// Stops all motion at once by the device's own means; the motors stay powered. An operational stop. A gripper that
    /// still moves afterwards is held by the device thread, which sends it to where it is.
    fn write_stop(&mut self) -> AdapterResult<Stop>;
    /// Enables or disables the servos.
    fn write_enable(&mut self, enable: bool) -> AdapterResult<()>;
    /// Clears the device's error state. Moves nothing, enables nothing.
    fn write_clear_errors(&mut self) -> AdapterResult<()>;
    /// Longest regular time between two setpoints that the device takes, known once it is connected. `None`: it takes
    /// one in every tick, or in every period of its states where that is longer.
    fn set_point_period(&self) -> Option<Duration> {
        None
    }
    /// Discards setpoints that have not left this computer. Called when the arm stopped answering, before anything else
    /// is sent: a setpoint that waits in a queue must not reach the arm later. By default the connection is dropped,
    /// and the device thread connects again; a TCP connection is reset, not closed, so that its send buffer is
    /// discarded.
    fn discard_pending(&mut self) {
        self.disconnect();
    }

    // --- Optional parts ---

    /// End-effector pose; `None` when the device has none.
    fn read_cartesian_position(&mut self) -> AdapterResult<Option<Pose>> {
        Ok(None)
    }
    /// Commands an end-effector pose; the device plans the way. `velocity` as above.
    fn write_cartesian_position(&mut self, _pose: &Pose, _velocity: f64) -> AdapterResult<()> {
        Err(AdapterError::Unsupported)
    }
    /// Gripper opening [m]; `None` when there is no gripper.
    fn read_gripper_position(&mut self) -> AdapterResult<Option<f64>> {
        Ok(None)
    }
    /// How far the gripper closes and opens [m], as the data sheet says: what `open` and `close` mean. `None` when
    /// there is no gripper, or nobody knows.
    fn get_gripper_range(&self) -> Option<(f64, f64)> {
        None
    }
    /// Commands the gripper opening [m].
    fn write_gripper_position(&mut self, _position: f64) -> AdapterResult<()> {
        Err(AdapterError::Unsupported)
    }
    /// Force and torque [N, N, N, Nm, Nm, Nm]; `None` when there is no sensor.
    fn read_force_torque(&mut self) -> AdapterResult<Option<[f64; 6]>> {
        Ok(None)
    }
}
