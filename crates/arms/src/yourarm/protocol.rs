//! The wire format of the YourArm controller: pure encoding and decoding, no I/O, no units but the wire's own
//! (deg, deg/s, mm, Nm, µs). The sheet is `docs/yourarm-protocol.md`; this file follows its order.
//!
//! Encoders write into the caller's buffer. Decoders answer `None` or skip for whatever bytes come; none panics.

use super::frame::{MAX_FRAME, Reader, Writer};

/// Number of joints.
pub const DOF: usize = 6;
/// The model name that the controller gives.
pub const MODEL: &str = "YOURARM-6";
/// The controller's TCP port.
pub const PORT: u16 = 9760;

/// One value per joint, in wire units.
pub type WireJoints = [f64; DOF];

/// What the controller can be asked.
#[derive(Debug, Clone, Copy, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "one at a time, and boxing it would allocate in every cycle")]
pub enum Command {
    /// Who are you?
    Hello,
    /// Everything that is measured, in one packet.
    GetState,
    /// Changes the mode; refused while the arm moves.
    SetMode(Mode),
    /// Motors on (holding where the arm is) or off.
    Enable(bool),
    /// Clears the error.
    ClearError,
    /// Decelerates to standstill; motors stay on.
    Stop,
    /// Plans and makes a move.
    MoveJoints {
        /// Speed [% of the top speed].
        speed: f64,
        /// Target [deg].
        joints: WireJoints,
    },
    /// Next setpoint [deg].
    ServoJoints(WireJoints),
    /// Joint velocities [deg/s]; the arm stops when no other follows within 200 ms.
    VelocityJoints(WireJoints),
    /// Next setpoint with all that it has.
    Setpoint(Setpoint),
    /// Plans and makes a move to a pose.
    MoveCartesian {
        /// Speed [% of the top speed].
        speed: f64,
        /// Target x, y, z [mm], roll, pitch, yaw [deg].
        pose: [f64; 6],
    },
    /// Gripper opening [mm], with the force of power-up.
    Gripper(f64),
    /// Gripper opening [mm] and largest force [N].
    Grip(f64, f64),
    /// Load at the flange: mass [kg], centre x, y, z [mm], inertia xx, xy, xz, yy, yz, zz [kg·m²].
    SetPayload([f64; 10]),
    /// That load.
    GetPayload,
    /// Direction of gravity in the base frame.
    SetMounting([f64; 3]),
    /// That direction.
    GetMounting,
    /// Condition of the joints' drives.
    GetJointStatus,
    /// Encoder offsets of the factory calibration [deg].
    GetOffsets,
    /// Levels of all inputs and outputs.
    GetIo,
    /// Level of a digital output.
    SetDigital(u8, bool),
    /// Voltage of an analogue output [V].
    SetAnalog(u8, f64),
}

/// A setpoint with all that it has; what is `None` is not on the wire.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Setpoint {
    /// The client's time when it was made [µs].
    pub time_us: u64,
    /// How long it holds [ms], at most 65 s; 0: until the next one.
    pub valid_ms: u16,
    /// Positions [deg] and velocities [deg/s].
    pub joints: [WireJoints; 2],
    /// Accelerations [deg/s²].
    pub acceleration: Option<WireJoints>,
    /// Torques [Nm].
    pub torque: Option<WireJoints>,
    /// Stiffness [Nm/rad] and damping [Nm·s/rad].
    pub gains: Option<[WireJoints; 2]>,
}

impl Command {
    /// The command's number on the wire.
    pub fn opcode(&self) -> u8 {
        match self {
            Self::Hello => 0x01,
            Self::GetState => 0x02,
            Self::SetMode(_) => 0x03,
            Self::Enable(_) => 0x04,
            Self::ClearError => 0x05,
            Self::Stop => 0x06,
            Self::MoveJoints { .. } => 0x10,
            Self::ServoJoints(_) => 0x11,
            Self::VelocityJoints(_) => 0x12,
            Self::Setpoint(_) => 0x14,
            Self::MoveCartesian { .. } => 0x13,
            Self::Gripper(_) => 0x20,
            Self::Grip(..) => 0x25,
            Self::SetPayload(_) => 0x21,
            Self::GetPayload => 0x22,
            Self::SetMounting(_) => 0x23,
            Self::GetMounting => 0x24,
            Self::GetJointStatus => 0x40,
            Self::GetOffsets => 0x41,
            Self::GetIo => 0x30,
            Self::SetDigital(..) => 0x31,
            Self::SetAnalog(..) => 0x32,
        }
    }

    /// The command's name on the sheet.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Hello => "HELLO",
            Self::GetState => "GET_STATE",
            Self::SetMode(_) => "SET_MODE",
            Self::Enable(_) => "ENABLE",
            Self::ClearError => "CLEAR_ERROR",
            Self::Stop => "STOP",
            Self::MoveJoints { .. } => "MOVE_JOINTS",
            Self::ServoJoints(_) => "SERVO_JOINTS",
            Self::VelocityJoints(_) => "VELOCITY_JOINTS",
            Self::Setpoint(_) => "SETPOINT",
            Self::MoveCartesian { .. } => "MOVE_CARTESIAN",
            Self::Gripper(_) => "GRIPPER",
            Self::Grip(..) => "GRIP",
            Self::SetPayload(_) => "SET_PAYLOAD",
            Self::GetPayload => "GET_PAYLOAD",
            Self::SetMounting(_) => "SET_MOUNTING",
            Self::GetMounting => "GET_MOUNTING",
            Self::GetJointStatus => "GET_JOINT_STATUS",
            Self::GetOffsets => "GET_OFFSETS",
            Self::GetIo => "GET_IO",
            Self::SetDigital(..) => "SET_DIGITAL",
            Self::SetAnalog(..) => "SET_ANALOG",
        }
    }
}

/// The controller's modes, with their numbers on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(u8)]
pub enum Mode {
    /// The controller plans the way.
    #[default]
    Position = 0,
    /// Follows setpoints.
    Servo = 1,
    /// Keeps velocities.
    Velocity = 2,
    /// Moves by stiffness, damping and torques.
    Impedance = 3,
}

impl Mode {
    fn from_wire(byte: u8) -> Option<Self> {
        match byte {
            0 => Some(Self::Position),
            1 => Some(Self::Servo),
            2 => Some(Self::Velocity),
            3 => Some(Self::Impedance),
            _ => None,
        }
    }
}

/// Payload of GET_STATE that asks for the gripper's force as well.
const WITH_FORCE: u8 = 1;

/// Writes the frame of a command into `frame`; the answer is the part that was written.
pub fn encode<'a>(command: &Command, sequence: u16, frame: &'a mut [u8; MAX_FRAME]) -> &'a [u8] {
    let mut out = Writer::new(frame);
    match command {
        Command::Hello | Command::ClearError | Command::Stop => {}
        Command::GetState => out.put(&[WITH_FORCE]),
        Command::GetIo | Command::GetPayload | Command::GetMounting => {}
        Command::GetJointStatus | Command::GetOffsets => {}
        Command::SetPayload(load) => out.floats(load),
        Command::SetMounting(gravity) => out.floats(gravity),
        Command::SetMode(mode) => out.put(&[*mode as u8]),
        Command::Enable(on) => out.put(&[u8::from(*on)]),
        Command::MoveJoints { speed, joints } => {
            out.floats(&[*speed]);
            out.floats(joints);
        }
        Command::ServoJoints(joints) | Command::VelocityJoints(joints) => out.floats(joints),
        Command::Setpoint(setpoint) => put_setpoint(&mut out, setpoint),
        Command::MoveCartesian { speed, pose } => {
            out.floats(&[*speed]);
            out.floats(pose);
        }
        Command::Gripper(opening) => out.floats(&[*opening]),
        Command::Grip(opening, force) => out.floats(&[*opening, *force]),
        Command::SetDigital(output, high) => out.put(&[*output, u8::from(*high)]),
        Command::SetAnalog(output, volts) => {
            out.put(&[*output]);
            out.floats(&[*volts]);
        }
    }
    out.finish(command.opcode(), sequence)
}

/// Flags of SETPOINT: which lists follow the velocities.
const ACCELERATION: u8 = 1;
const TORQUE: u8 = 2;
const GAINS: u8 = 4;

fn put_setpoint(out: &mut Writer<'_>, setpoint: &Setpoint) {
    let has = |flag: u8, there: bool| if there { flag } else { 0 };
    let flags = has(ACCELERATION, setpoint.acceleration.is_some())
        | has(TORQUE, setpoint.torque.is_some())
        | has(GAINS, setpoint.gains.is_some());
    out.put(&[flags]);
    out.put(&setpoint.valid_ms.to_le_bytes());
    out.put(&setpoint.time_us.to_le_bytes());
    let lists = setpoint.joints.iter().chain(&setpoint.acceleration).chain(&setpoint.torque);
    lists.chain(setpoint.gains.iter().flatten()).for_each(|list| out.floats(list));
}

// --- Replies: status u8, then data; a refusal carries the controller's error code (u16) ---

/// Refused because the controller is in error; the data tell which.
pub const IN_ERROR: u8 = 8;

/// Why the controller refused, in words.
pub fn status_text(status: u8) -> &'static str {
    match status {
        1 => "it does not know the command",
        2 => "a value is malformed",
        3 => "another client is connected to it",
        4 => "the motors are disabled",
        5 => "it is in another mode",
        6 => "the arm is moving",
        7 => "a value is outside the arm's limits, or the target is out of reach",
        IN_ERROR => "it is in error",
        9 => "there is no gripper",
        10 => "there is no such channel",
        _ => "it gives a reason that the sheet does not list",
    }
}

/// What an error code of the controller means.
pub fn error_text(code: u16) -> &'static str {
    match code {
        0 => "",
        1 => "E-stop line open",
        2 => "collision detected",
        3 => "joint over-temperature",
        4 => "joint over-current",
        5 => "following error too large",
        6 => "joint beyond its position limit",
        7 => "servo drive does not answer",
        8 => "supply voltage out of range",
        _ => "an error that the sheet does not list",
    }
}

/// The reply to [`Command::Hello`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Hello {
    /// Model name.
    pub model: String,
    /// Number of joints.
    pub dof: usize,
    /// Firmware version.
    pub firmware: [u8; 3],
    /// Serial number.
    pub serial: String,
}

impl Hello {
    /// Decodes the data of a good reply.
    pub fn decode(data: &[u8]) -> Option<Self> {
        let mut data = Reader::new(data);
        let model = data.text()?;
        let [dof, major, minor, patch] = data.take()?;
        let serial = data.text()?;
        data.is_empty().then_some(Self { model, dof: dof.into(), firmware: [major, minor, patch], serial })
    }
}

/// The reply to [`Command::GetState`]. All numbers are finite.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct State {
    /// Time of the measurement since power-up [µs].
    pub time_us: u64,
    /// 0 disabled, 1 standing, 2 moving, 3 in error.
    pub state: u8,
    /// The mode.
    pub mode: Mode,
    /// Whether the motors are on.
    pub enabled: bool,
    /// Whether a gripper is fitted.
    pub gripper_fitted: bool,
    /// The error; 0 = none.
    pub error: u16,
    /// Joint positions [deg].
    pub positions: WireJoints,
    /// Joint velocities [deg/s].
    pub velocities: WireJoints,
    /// Joint torques [Nm].
    pub torques: WireJoints,
    /// Gripper opening [mm].
    pub gripper: f64,
    /// Flange x, y, z [mm], roll, pitch, yaw [deg].
    pub pose: [f64; 6],
    /// Measured force of the gripper [N].
    pub gripper_force: f64,
}

impl State {
    /// Decodes the data of a good reply. `None` also when a number is not finite: such a packet is not to be trusted.
    pub fn decode(data: &[u8]) -> Option<Self> {
        let mut data = Reader::new(data);
        let time_us = u64::from_le_bytes(data.take()?);
        let [state, mode, flags, dof] = data.take()?;
        if usize::from(dof) != DOF {
            return None;
        }
        let decoded = Self {
            time_us,
            state,
            mode: Mode::from_wire(mode)?,
            enabled: flags & 1 != 0,
            gripper_fitted: flags & 2 != 0,
            error: u16::from_le_bytes(data.take()?),
            positions: data.floats()?,
            velocities: data.floats()?,
            torques: data.floats()?,
            gripper: data.float()?,
            pose: data.floats()?,
            gripper_force: data.float()?,
        };
        data.is_empty().then_some(decoded)
    }
}

/// Number of digital inputs, and of digital outputs.
pub const DIGITAL: u8 = 8;
/// Number of analogue inputs, and of analogue outputs.
pub const ANALOG: usize = 2;

/// The reply to [`Command::GetIo`]. All numbers are finite.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Io {
    /// Levels of the digital inputs: bit i is input i.
    pub digital_inputs: u16,
    /// Levels of the digital outputs: bit i is output i.
    pub digital_outputs: u16,
    /// Voltages of the analogue inputs [V].
    pub analog_inputs: [f64; ANALOG],
    /// Voltages of the analogue outputs [V].
    pub analog_outputs: [f64; ANALOG],
}

impl Io {
    /// Decodes the data of a good reply.
    pub fn decode(data: &[u8]) -> Option<Self> {
        let mut data = Reader::new(data);
        let decoded = Self {
            digital_inputs: u16::from_le_bytes(data.take()?),
            digital_outputs: u16::from_le_bytes(data.take()?),
            analog_inputs: data.floats()?,
            analog_outputs: data.floats()?,
        };
        data.is_empty().then_some(decoded)
    }
}

/// Condition of a joint's drive. All numbers are finite.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Drive {
    /// Temperature of the motor [°C].
    pub temperature: f64,
    /// Motor current [A].
    pub current: f64,
    /// Supply voltage [V].
    pub voltage: f64,
    /// Load [% of the rated torque], signed.
    pub load: f64,
    /// The drive's error code; 0 = none.
    pub error: u16,
}

/// Decodes the data of a good reply to [`Command::GetJointStatus`].
pub fn decode_drives(data: &[u8]) -> Option<[Drive; DOF]> {
    let mut data = Reader::new(data);
    let mut drives = [Drive::default(); DOF];
    for drive in &mut drives {
        let [temperature, current, voltage, load] = data.floats()?;
        *drive = Drive { temperature, current, voltage, load, error: u16::from_le_bytes(data.take()?) };
    }
    data.is_empty().then_some(drives)
}

/// Decodes the data of a good reply that consists of N numbers: of [`Command::GetPayload`] (10),
/// [`Command::GetMounting`] (3) and [`Command::GetOffsets`] (6).
pub fn decode_floats<const N: usize>(data: &[u8]) -> Option<[f64; N]> {
    let mut data = Reader::new(data);
    let values = data.floats()?;
    data.is_empty().then_some(values)
}

/// The controller's error code in the data of a refusal.
pub fn decode_refusal(data: &[u8]) -> Option<u16> {
    Reader::new(data).take().map(u16::from_le_bytes)
}

#[cfg(test)]
#[path = "protocol_tests.rs"]
mod tests;
