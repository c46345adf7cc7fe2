//! The interface between this program and an arm: [`ManipulatorAdapter`].
//!
//! All values are in SI units: rad, rad/s, Nm, m, N. A new arm implements the methods without a default body, and
//! overrides the others if its device has the feature; the defaults report a missing feature. Features that only some
//! arms have are separate traits: [`Gripper`], [`ForceTorque`], [`Cartesian`], [`Io`],
//! [`Payload`], [`JointMonitor`], [`HandGuiding`].
//!
//! A device is either polled, or streams its state. For the second kind, [`ManipulatorAdapter::state_fd`] returns the
//! descriptor on which the state arrives: the device thread then reads when data has arrived, so the age of the state
//! depends on the device only.

mod hand_guiding;
mod io;
mod joint_monitor;
mod payload;

use std::os::fd::BorrowedFd;
use std::time::Duration;

use dimos_core::arm::{
    Bridging, Commanded, ControllerPose, EffortKind, FactoryKinematics, ForceUnit, GripperInfo, GripperUnit, Impedance,
    JointSet, Pose, Setpoint, SetpointFields, StopPoint,
};
use dimos_core::clock::Mono;
use dimos_core::joint::{ControlMode, JointLimits, Joints, MAX_DOF};

pub use hand_guiding::HandGuiding;
pub use io::Io;
pub use joint_monitor::JointMonitor;
pub use payload::Payload;

/// Why an adapter call failed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum AdapterError {
    /// The connection failed or broke.
    #[error("{0}")]
    Io(String),
    /// The device did not answer in time.
    #[error("{0}")]
    Timeout(String),
    /// The device sent an invalid or unexpected reply.
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
    /// Not a failure of the device: two setpoints are still unacknowledged, so this one was not sent; or the errors are
    /// being cleared.
    #[error("busy: two setpoints are unacknowledged, or errors are still being cleared")]
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

/// Description of an arm.
#[derive(Debug, Clone, PartialEq)]
pub struct ManipulatorInfo {
    /// Vendor.
    pub vendor: String,
    /// Model.
    pub model: String,
    /// Number of joints.
    pub dof: usize,
    /// Firmware version, if the device reports it.
    pub firmware_version: Option<String>,
    /// Serial number, if the device reports it.
    pub serial_number: Option<String>,
    /// Rate at which the device can deliver its state [Hz].
    pub native_rate: f64,
    /// The modes that `set_control_mode` accepts.
    pub modes: &'static [ControlMode],
    /// Whether the arm keeps its pose when its motors are disabled (brakes), or falls.
    pub holds_when_disabled: bool,
    /// Whether `read_joints` gets the whole state, so that the other reads are answered from memory. Otherwise each
    /// costs a round trip, and one of them is made per cycle.
    pub whole_state_at_once: bool,
}

/// Joint positions, velocities and efforts from one reading.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct JointReading {
    /// When the device measured, if it reports that (translated to the monotonic clock).
    pub stamp: Option<Mono>,
    /// The same time on the device's own clock, from its own zero [ns], if it reports that: for the log.
    pub device_ns: Option<u64>,
    /// Joint positions [rad or m].
    pub position: Joints,
    /// Joint velocities [rad/s or m/s], if the device has them.
    pub velocity: Option<Joints>,
    /// Joint efforts [Nm or N], if the device has them.
    pub effort: Option<Joints>,
    /// Where the efforts come from.
    pub effort_kind: EffortKind,
    /// Joints whose motors do not answer: their entries above do not count. An arm of which some motors answer is
    /// reachable; with all missing, a read is an error.
    pub missing: JointSet,
    /// Whether the device confirms that the positions are measured: `Some(false)` means not yet, `None` that the device
    /// cannot tell. Without a confirmation, exactly zero on all joints counts as missing when the motors are to be
    /// enabled.
    pub valid: Option<bool>,
    /// What the controller itself commands its joints, if it reports that: measured or estimated values do not belong
    /// here.
    pub commanded: Option<Commanded>,
    /// Fraction of its speed at which the controller runs motions at present, 0 to 1, if it reports that: setpoints are
    /// then sent so much slower. Not a fraction that this run has set.
    pub speed_fraction: Option<f64>,
}

/// What the settings of an arm's controller leave of its limits.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Reduction {
    /// Highest speed of the tool [m/s], if the settings limit it.
    pub tool_velocity: Option<f64>,
    /// The settings, for `status`.
    pub text: String,
}

/// The device's own state codes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RobotState {
    /// The device's state code.
    pub state: i32,
    /// The device's mode code.
    pub mode: i32,
}

/// Result of `write_stop`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stop {
    /// The device confirmed the stop.
    Confirmed,
    /// The stop was sent; the device has no way to confirm it.
    Sent,
}

/// Interface of the program to an arm. One device thread owns it and makes all calls.
///
/// Methods that fill a slice get one of length dof and must not allocate: they run every cycle.
pub trait ManipulatorAdapter: Send {
    // --- Lifecycle ---

    /// Connects and verifies the device. Moves and enables nothing.
    fn connect(&mut self) -> AdapterResult<()>;
    /// Closes the connection. Never fails; has no effect when not connected.
    fn disconnect(&mut self);
    /// Returns whether the connection is up, without asking the device.
    fn is_connected(&self) -> bool;
    /// Prepares for commanded motion: enables the motors and holds the current position.
    fn activate(&mut self) -> AdapterResult<()> {
        self.write_enable(true)
    }
    /// Ends commanded motion in a regular way, before `disconnect`: the arm is to rest at `rest`. The motors stay on or
    /// off.
    fn deactivate(&mut self, rest: &StopPoint) -> AdapterResult<()> {
        self.write_stop(rest).map(|_| ())
    }

    // --- Identity ---

    /// Returns vendor, model, dof, versions, rate, modes.
    fn get_info(&self) -> ManipulatorInfo;
    /// Returns what a user must know of the arm that is connected, such as a guard that its reports make useless. The
    /// run logs it as a warning, once.
    fn connection_warning(&self) -> Option<&'static str> {
        None
    }
    /// Returns the number of joints.
    fn get_dof(&self) -> usize;
    /// Returns the joint limits, known or read from the device.
    fn get_limits(&mut self) -> AdapterResult<JointLimits>;
    /// Takes the limits of commands: those of `get_limits`, narrowed by the blueprint. An adapter that makes commands
    /// of its own between setpoints, for example to catch up with them, keeps to these. Called after the first
    /// `connect`; they outlive connections.
    fn set_limits(&mut self, _limits: &JointLimits) {}

    /// Returns the arm's dimensions by its data sheet, and its own ones as its maker measured them; `None` for an arm
    /// whose controller has none. Known once connected.
    fn factory_kinematics(&self) -> Option<FactoryKinematics> {
        None
    }

    /// Returns what the arm itself says of gaps in its setpoints; `None`: the figures of its row hold. Known once
    /// connected.
    fn bridging(&self) -> Option<Bridging> {
        None
    }

    /// Returns what the arm takes of setpoints, if it says so itself; `None`: what its row says holds. Known once
    /// connected.
    fn setpoint_fields(&self) -> Option<SetpointFields> {
        None
    }
    /// Returns how the arm is held in impedance mode, if it says so itself; `None`: what its row says holds. Known once
    /// connected.
    fn impedance(&self) -> Option<Impedance> {
        None
    }

    /// Returns what the settings of the arm's controller, such as a reduced mode, leave of its limits, in words and
    /// beyond [`get_limits`](Self::get_limits), which has them too; `None`: nothing is known of them. Known once
    /// connected.
    fn reduction(&self) -> Option<Reduction> {
        None
    }
    /// Returns whether these settings have changed since `get_limits`. Must not allocate.
    fn reduction_changed(&self) -> bool {
        false
    }

    // --- Mode ---

    /// Sets the control mode; `Unsupported` for one that the device lacks.
    fn set_control_mode(&mut self, mode: ControlMode) -> AdapterResult<()>;
    /// Returns the mode of the device, as it reports it if it can.
    fn get_control_mode(&self) -> ControlMode;

    /// Returns what another client of the device, or a person at its panel, changed since the last `activate` or
    /// `set_control_mode`: a stop, a pause, another mode, motors off. `None`: no change, or the device itself is the
    /// cause (`read_error`). An adapter never undoes such a change. Must not allocate.
    fn foreign_change(&self) -> Option<&'static str> {
        None
    }

    // --- State ---

    /// For a device that streams its state: returns the descriptor that becomes readable when data has arrived. The
    /// device thread then calls [`ManipulatorAdapter::read_joints`] at once, which must process everything that has
    /// arrived without waiting, and return the newest state with its own `stamp`, the same as before if there is no
    /// newer one. It returns an error once the device has been silent for too long. `None`: the device is polled.
    fn state_fd(&self) -> Option<BorrowedFd<'_>> {
        None
    }
    /// Fills in the joint positions [rad].
    fn read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()>;
    /// Fills in the joint velocities [rad/s]; `false` if the device has none (the coordinator estimates them).
    fn read_joint_velocities(&mut self, _velocities: &mut [f64]) -> AdapterResult<bool> {
        Ok(false)
    }
    /// Fills in the joint torques [Nm]; `false` if the device has none.
    fn read_joint_efforts(&mut self, _efforts: &mut [f64]) -> AdapterResult<bool> {
        Ok(false)
    }
    /// Reads positions, velocities and torques. Override it for a device that sends them in one packet.
    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        let dof = self.get_dof().min(MAX_DOF);
        let mut buffer = [0.0; MAX_DOF];
        let slice = buffer.get_mut(..dof).unwrap_or_default();
        (reading.stamp, reading.device_ns, reading.commanded) = (None, None, None);
        (reading.effort_kind, reading.missing) = (EffortKind::Unstated, JointSet::NONE);
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
    /// Returns the device's own state and mode codes.
    fn read_state(&mut self) -> AdapterResult<RobotState>;
    /// Returns the device's error: code and text; `(0, "")` without an error. The text is built only for an error, so a
    /// healthy cycle allocates nothing.
    fn read_error(&mut self) -> AdapterResult<(i32, String)>;
    /// Returns whether the motors are enabled.
    fn read_enabled(&mut self) -> AdapterResult<bool>;

    // --- Motion ---

    /// Commands joint positions [rad]. `velocity` is a fraction of the device's top speed (0–1], used where the device
    /// plans the motion.
    fn write_joint_positions(&mut self, positions: &[f64], velocity: f64) -> AdapterResult<()>;
    /// Commands joint velocities [rad/s].
    fn write_joint_velocities(&mut self, _velocities: &[f64]) -> AdapterResult<()> {
        Err(AdapterError::Unsupported)
    }
    /// Commands a setpoint of a tick: positions, and what else the arm takes of it. What the row says is taken must
    /// reach the arm; what is `None` must not be sent as zero. By default
    /// [`write_joint_positions`](Self::write_joint_positions), in the modes of positions. In velocity mode,
    /// [`write_joint_velocities`](Self::write_joint_velocities) is called instead.
    fn write_setpoint(&mut self, setpoint: &Setpoint) -> AdapterResult<()> {
        match setpoint.mode {
            ControlMode::Position | ControlMode::ServoPosition => {
                self.write_joint_positions(setpoint.position.get(..self.get_dof()).unwrap_or_default(), 1.0)
            }
            _ => Err(AdapterError::Unsupported),
        }
    }
    /// Returns whether the device answers each command with its state, as motors in MIT mode and EtherCAT drives do:
    /// [`exchange`](Self::exchange) is then called instead of `write_setpoint` and `read_joints`. Never changes while
    /// the arm is connected.
    fn exchanges(&self) -> bool {
        false
    }
    /// Commands a setpoint, and takes the state that answers it; without one, asks for the state in a way that commands
    /// nothing. An error of the command is the error. By default one after the other.
    fn exchange(&mut self, setpoint: Option<&Setpoint>, reading: &mut JointReading) -> AdapterResult<()> {
        if let Some(setpoint) = setpoint {
            self.write_setpoint(setpoint)?;
        }
        self.read_joints(reading)
    }
    /// Stops all motion at once with the device's own stop; the motors stay powered. An operational stop. An arm whose
    /// controller only takes goals is given `rest` as its goal; no adapter makes a goal from a measurement, which may
    /// be wrong. The device thread holds a gripper that still moves afterwards at its current position.
    fn write_stop(&mut self, rest: &StopPoint) -> AdapterResult<Stop>;
    /// Enables or disables the motors.
    fn write_enable(&mut self, enable: bool) -> AdapterResult<()>;
    /// Clears the device's error state. Moves and enables nothing. `Busy` while that takes time: the device thread then
    /// calls it again in the next cycle, for at most 7.5 s, and reads and stops the arm meanwhile.
    fn write_clear_errors(&mut self) -> AdapterResult<()>;
    /// Returns the longest regular time between two setpoints, known once connected. `None`: one per tick or, if
    /// longer, per period of the states.
    fn set_point_period(&self) -> Option<Duration> {
        None
    }
    /// Discards setpoints that have not left this computer. Called when the arm stopped answering, before anything else
    /// is sent: a queued setpoint must not reach the arm later. By default the connection is dropped, and the device
    /// thread reconnects. A TCP connection is reset, not closed, which discards its send buffer.
    fn discard_pending(&mut self) {
        self.disconnect();
    }

    // --- Optional parts: an adapter writes only those that its arm has ---

    /// Returns the arm's gripper; `None` if there is none. Does not change while the arm is connected.
    fn gripper(&mut self) -> Option<&mut dyn Gripper> {
        None
    }
    /// Returns the force/torque sensor at the flange; `None` if there is none. Does not change while the arm is
    /// connected.
    fn force_torque(&mut self) -> Option<&mut dyn ForceTorque> {
        None
    }
    /// Returns the device's own kinematics; `None` if it has none. Does not change while the arm is connected.
    fn cartesian(&mut self) -> Option<&mut dyn Cartesian> {
        None
    }
    /// Returns the controller's digital and analogue inputs and outputs; `None` if it has none. Does not change while
    /// the arm is connected.
    fn io(&mut self) -> Option<&mut dyn Io> {
        None
    }
    /// Returns the load at the flange, as the controller takes it; `None` if it takes none. Does not change while the
    /// arm is connected.
    fn payload(&mut self) -> Option<&mut dyn Payload> {
        None
    }
    /// Returns the condition of the joints' drives; `None` if the device reports none. Does not change while the arm is
    /// connected.
    fn joint_monitor(&mut self) -> Option<&mut dyn JointMonitor> {
        None
    }
    /// Returns the arm's guiding by hand; `None` if it has none. Does not change while the arm is connected.
    fn hand_guiding(&mut self) -> Option<&mut dyn HandGuiding> {
        None
    }
}

/// A gripper with one degree of freedom: fingers along one axis, or a rotary jaw. The adapter usually implements it
/// itself, and [`ManipulatorAdapter::gripper`] returns `Some(self)`.
///
/// ```
/// use dimos_hardware::adapter::{AdapterError, AdapterResult, Gripper};
///
/// struct Fingers {
///     opening: f64,
/// }
///
/// impl Gripper for Fingers {
///     fn read_gripper_position(&mut self) -> AdapterResult<Option<f64>> {
///         Ok(Some(self.opening))
///     }
///     fn write_gripper_position(&mut self, position: f64) -> AdapterResult<()> {
///         if !(0.0..=0.08).contains(&position) {
///             return Err(AdapterError::Rejected(format!("the gripper opens 0 to 0.08 m, not {position} m")));
///         }
///         self.opening = position;
///         Ok(())
///     }
/// }
///
/// let mut fingers = Fingers { opening: 0.0 };
/// fingers.write_gripper_position(0.05).unwrap();
/// assert_eq!(fingers.read_gripper_position(), Ok(Some(0.05)));
/// assert!(fingers.write_gripper_position(0.09).is_err());
/// ```
pub trait Gripper {
    /// Returns the unit of positions: metres of opening, or radians for a rotary jaw. Never changes.
    fn get_gripper_unit(&self) -> GripperUnit {
        GripperUnit::Meters
    }
    /// Returns the position [m or rad]; `None` while it is unknown. Must not allocate.
    fn read_gripper_position(&mut self) -> AdapterResult<Option<f64>>;
    /// Commands the position [m or rad], with the force that is set in the device. `Rejected` outside the range: then
    /// nothing moves.
    fn write_gripper_position(&mut self, position: f64) -> AdapterResult<()>;
    /// Returns the position when closed and when open [m or rad], according to data sheet or calibration; `None` if
    /// unknown.
    fn get_gripper_range(&mut self) -> Option<(f64, f64)> {
        None
    }
    /// Returns the unit of forces: by default N, and Nm for a rotary jaw. A device may also state the torque of its
    /// motor, or percent. Never changes.
    fn get_gripper_force_unit(&self) -> ForceUnit {
        match self.get_gripper_unit() {
            GripperUnit::Meters => ForceUnit::Newtons,
            GripperUnit::Radians => ForceUnit::NewtonMeters,
            GripperUnit::OnOff => ForceUnit::Percent,
        }
    }
    /// Returns the smallest and the largest force that can be commanded [their unit]; `None` without force control.
    fn get_gripper_force_range(&mut self) -> Option<(f64, f64)> {
        None
    }
    /// Commands the position [m or rad] with a largest force [its unit]. `Rejected` outside either range: then nothing
    /// moves. The force is that of this command: the next one without a force has the device's own again.
    fn write_gripper_position_with_force(&mut self, _position: f64, _force: f64) -> AdapterResult<()> {
        Err(AdapterError::Unsupported)
    }
    /// Returns the measured force [its unit]; `None` if the device measures none. Must not allocate.
    fn read_gripper_force(&mut self) -> AdapterResult<Option<f64>> {
        Ok(None)
    }
    /// Returns whether the device itself reports an object in its grip; `None` if it cannot tell: the outcome of a
    /// command is then judged from position and force. Must not allocate.
    fn read_gripper_holds(&mut self) -> AdapterResult<Option<bool>> {
        Ok(None)
    }
    /// Returns whether commands may have a speed. Never changes.
    fn has_gripper_speed(&self) -> bool {
        false
    }
    /// Sets the speed of the commands that follow, as a fraction of the gripper's top speed (0–1]; `None`: the device's
    /// own. Called before every command of a gripper that `has_gripper_speed`.
    fn set_gripper_speed(&mut self, _fraction: Option<f64>) {}
}

impl dyn Gripper + '_ {
    /// Returns units and ranges.
    pub fn info(&mut self) -> GripperInfo {
        GripperInfo {
            unit: self.get_gripper_unit(),
            range: self.get_gripper_range(),
            force_unit: self.get_gripper_force_unit(),
            force_range: self.get_gripper_force_range(),
            has_speed: self.has_gripper_speed(),
        }
    }

    /// Commands the position, with a largest force and a speed (fraction of the top speed) if there are any.
    pub fn command(&mut self, position: f64, force: Option<f64>, speed: Option<f64>) -> AdapterResult<()> {
        match self.has_gripper_speed() {
            true => self.set_gripper_speed(speed),
            false if speed.is_some() => return Err(AdapterError::Unsupported),
            false => {}
        }
        match force {
            Some(force) => self.write_gripper_position_with_force(position, force),
            None => self.write_gripper_position(position),
        }
    }
}

/// A force/torque sensor.
pub trait ForceTorque {
    /// Returns force and torque [N, N, N, Nm, Nm, Nm]; `None` while the sensor is not ready. Must not allocate.
    fn read_force_torque(&mut self) -> AdapterResult<Option<[f64; 6]>>;
}

/// The device's own kinematics.
pub trait Cartesian {
    /// Returns the pose of the device's tool centre point with the offsets that make it that of the flange; `None`
    /// while it is unknown. A device that has no tool of its own states its flange: [`ControllerPose::of_flange`]. An
    /// offset that it does not report is `None`, never zero. Must not allocate.
    fn read_cartesian_position(&mut self) -> AdapterResult<Option<ControllerPose>>;
    /// Commands a pose of the device's tool centre point in its reference frame, as
    /// [`ControllerPose::tcp_at`] returns it; the device plans the motion. `velocity` as in
    /// [`ManipulatorAdapter::write_joint_positions`]. Called in mode [`ControlMode::Position`]; no setpoint follows
    /// until the arm is activated again.
    fn write_cartesian_position(&mut self, _pose: &Pose, _velocity: f64) -> AdapterResult<()> {
        Err(AdapterError::Unsupported)
    }
}
