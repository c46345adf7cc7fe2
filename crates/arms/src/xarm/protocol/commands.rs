//! What the controller can be asked, as far as the adapter needs it.

use std::time::Duration;

use super::frame::{MAX_REQUEST, Writer};
use super::gripper::Rtu;

/// One value per joint on the wire: seven, whatever the arm; those that it lacks are zero.
pub type WireJoints = [f64; 7];

/// Joint number for all joints.
const ALL_JOINTS: u8 = 8;
/// The number of the tool flange among the devices behind the controller.
const TOOL: u8 = 0x09;

/// Reply timeouts. Setpoints and questions are answered within a few ms; what resets the controller or goes to a device
/// behind it takes longer (the vendor's client waits 2 s), and motors that are switched on longest (5 s).
pub const QUICK: Duration = Duration::from_millis(200);
/// See [`QUICK`].
pub const SLOW: Duration = Duration::from_secs(2);
const MOTORS: Duration = Duration::from_secs(5);

/// `set_state`: ready for motion.
pub const READY: u8 = 0;
/// `set_state`: stop at once.
pub const STOP: u8 = 4;

/// A request.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Command {
    /// Which arm, which firmware.
    Version,
    /// Serial numbers of arm and control box.
    Serials,
    /// Whether reports hold currents in the place of torques.
    ReportsCurrents,
    /// Motors of all joints on or off.
    Enable(bool),
    /// [`READY`] or [`STOP`].
    SetState(u8),
    /// The state.
    GetState,
    /// Error and warning.
    GetError,
    /// Clears the error.
    ClearError,
    /// Clears the warning.
    ClearWarning,
    /// Changes the mode.
    SetMode {
        /// 0 planned, 1 servo, 4 joint velocity.
        mode: u8,
        /// Enables collision detection in this mode too, for firmware with this parameter.
        detect: bool,
    },
    /// Plans and makes a move of the tool in a straight line.
    MoveLine {
        /// Target x, y, z [mm], roll, pitch, yaw [rad].
        pose: [f64; 6],
        /// [mm/s]
        speed: f64,
        /// [mm/s²]
        acceleration: f64,
    },
    /// Plans and makes a move of the joints.
    MoveJoints {
        /// Target [rad].
        joints: WireJoints,
        /// [rad/s]
        speed: f64,
        /// [rad/s²]
        acceleration: f64,
    },
    /// Next setpoint [rad].
    Servo(WireJoints),
    /// Joint velocities.
    Velocity {
        /// [rad/s]
        joints: WireJoints,
        /// The arm stops when no other follows within this time [s]; only newer firmware knows it.
        duration: Option<f64>,
    },
    /// The settings of reduced mode.
    ReducedMode,
    /// Errors of the joints' servos.
    ServoErrors,
    /// Something to the device at the tool flange, and its answer.
    Tool(Rtu),
    /// A register of the tool board.
    ReadToolBoard(u16),
    /// Sets a register of the tool board.
    WriteToolBoard(u16, u16),
    /// Load at the flange: mass [kg], centre x, y, z [mm]. Resets the controller: mode 0, not ready.
    SetLoad([f64; 4]),
    /// The force/torque sensor on or off.
    EnableForceTorque(bool),
}

impl Command {
    /// The register that it goes to.
    pub fn register(&self) -> u8 {
        match self {
            Self::Version => 1,
            Self::Serials => 2,
            Self::ReportsCurrents => 5,
            Self::Enable(_) => 11,
            Self::SetState(_) => 12,
            Self::GetState => 13,
            Self::GetError => 15,
            Self::ClearError => 16,
            Self::ClearWarning => 17,
            Self::SetMode { .. } => 19,
            Self::MoveLine { .. } => 21,
            Self::MoveJoints { .. } => 23,
            Self::Servo(_) => 29,
            Self::SetLoad(_) => 36,
            Self::ReducedMode => 53,
            Self::Velocity { .. } => 81,
            Self::ServoErrors => 106,
            Self::Tool(_) => 124,
            Self::WriteToolBoard(..) => 127,
            Self::ReadToolBoard(_) => 128,
            Self::EnableForceTorque(_) => 201,
        }
    }

    /// How long its reply may take.
    pub fn timeout(&self) -> Duration {
        match self {
            Self::Enable(_) => MOTORS,
            Self::SetState(_) | Self::SetMode { .. } | Self::ClearError | Self::ClearWarning => SLOW,
            Self::Tool(_) | Self::ReadToolBoard(_) | Self::WriteToolBoard(..) => SLOW,
            Self::EnableForceTorque(_) | Self::SetLoad(_) => SLOW,
            _ => QUICK,
        }
    }

    /// Writes the request into `frame`; the answer is the part that was written.
    pub fn encode<'a>(&self, transaction: u16, protocol: u16, frame: &'a mut [u8; MAX_REQUEST]) -> &'a [u8] {
        let mut out = Writer::new(frame);
        match self {
            Self::Version | Self::Serials | Self::ReportsCurrents | Self::GetState | Self::GetError => {}
            Self::ClearError | Self::ClearWarning | Self::ServoErrors | Self::ReducedMode => {}
            Self::Enable(on) => out.put(&[ALL_JOINTS, u8::from(*on)]),
            Self::SetState(state) => out.put(&[*state]),
            Self::SetMode { mode, detect: false } => out.put(&[*mode]),
            Self::SetMode { mode, detect: true } => out.put(&[*mode, 0]),
            Self::MoveLine { pose, speed, acceleration } => {
                out.floats(pose);
                out.floats(&[*speed, *acceleration, 0.0]);
            }
            Self::MoveJoints { joints, speed, acceleration } => {
                out.floats(joints);
                out.floats(&[*speed, *acceleration, 0.0]);
            }
            Self::Servo(joints) => {
                out.floats(joints);
                out.floats(&[0.0; 3]); // speed, acceleration and time, which the firmware ignores
            }
            Self::Velocity { joints, duration } => {
                out.floats(joints);
                out.put(&[1]); // all joints begin and end together
                if let Some(duration) = duration {
                    out.floats(&[*duration]);
                }
            }
            Self::Tool(rtu) => {
                out.put(&[TOOL]);
                out.put(rtu.bytes());
            }
            Self::ReadToolBoard(address) => {
                out.put(&[TOOL]);
                out.put(&address.to_be_bytes());
            }
            Self::WriteToolBoard(address, value) => {
                out.put(&[TOOL]);
                out.put(&address.to_be_bytes());
                out.floats(&[f64::from(*value)]);
            }
            Self::SetLoad(load) => out.floats(load),
            Self::EnableForceTorque(on) => out.put(&[u8::from(*on)]),
        }
        out.finish(self.register(), transaction, protocol)
    }
}
