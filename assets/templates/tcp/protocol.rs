//! The wire format: pure encoding and decoding, in the wire's own units (deg, deg/s, Nm, µs). No I/O here.
//!
//! YOUR ARM: this sheet is made up, in the way most controllers speak that answer each command. Write down the
//! vendor's here, and then change the code below to match it.
//!
//! ```text
//! command  A5 | opcode | number | length | payload         | sum     all numbers big-endian, floats of 4 bytes
//! reply    5A | opcode | number | length | status, payload | sum     sum: u16, of all bytes before it
//!
//! 01 HELLO     –                          → model u16, joints u8, firmware major u8, minor u8, serial number u32
//! 02 STATE     –                          → time u64 [µs], flags u8 (1 motors on, 2 moving), mode u8, error u16,
//!                                           positions [deg], velocities [deg/s], torques [Nm]: a float per joint
//! 03 MODE      0 planned, 1 setpoints, 2 velocities; refused while the arm moves
//! 04 ENABLE    0 motors off, 1 on (the arm holds where it is)
//! 05 CLEAR     –   clears the error
//! 06 STOP      –   decelerates; the motors stay on
//! 10 MOVE      speed [%], target [deg] per joint
//! 11 SERVO     next setpoint [deg] per joint
//! 12 VELOCITY  [deg/s] per joint; the arm stops when no other follows within 200 ms
//!
//! status  0 done, 1 unknown, 2 malformed, 3 motors off, 4 wrong mode, 5 moving, 6 out of range, 7 in error, 8 busy
//! error   0 none, 1 E-stop line open, 2 collision, 3 joint too hot, 4 following error
//! ```

use dimos_hardware::transport::Scan;

use super::DOF;

/// What the controller says its model is.
pub const MODEL: u16 = 1; // YOUR ARM

/// Bytes before the payload, and after it.
const HEADER: usize = 4;
const SUM: usize = 2;
/// Room for the longest command.
pub const MAX_COMMAND: usize = HEADER + 4 * (1 + DOF) + SUM;

/// One value per joint, in wire units.
pub type WireJoints = [f64; DOF];

/// What the controller can be asked.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Command {
    Hello,
    State,
    Mode(Mode),
    Enable(bool),
    Clear,
    Stop,
    /// Speed [%], target [deg].
    Move(f64, WireJoints),
    /// Setpoint [deg].
    Servo(WireJoints),
    /// Velocities [deg/s].
    Velocity(WireJoints),
}

/// The controller's modes, with their numbers on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(u8)]
pub enum Mode {
    #[default]
    Planned = 0,
    SetPoints = 1,
    Velocities = 2,
}

impl Command {
    /// The command's number and name on the sheet.
    pub fn sheet(&self) -> (u8, &'static str) {
        match self {
            Self::Hello => (0x01, "HELLO"),
            Self::State => (0x02, "STATE"),
            Self::Mode(_) => (0x03, "MODE"),
            Self::Enable(_) => (0x04, "ENABLE"),
            Self::Clear => (0x05, "CLEAR"),
            Self::Stop => (0x06, "STOP"),
            Self::Move(..) => (0x10, "MOVE"),
            Self::Servo(_) => (0x11, "SERVO"),
            Self::Velocity(_) => (0x12, "VELOCITY"),
        }
    }
}

/// Writes the frame of a command into `frame`; the answer is the part that was written.
pub fn encode<'a>(command: &Command, number: u8, frame: &'a mut [u8; MAX_COMMAND]) -> &'a [u8] {
    let mut at = HEADER;
    let mut put = |bytes: &[u8]| {
        if let Some(to) = frame.get_mut(at..at + bytes.len()) {
            to.copy_from_slice(bytes);
            at += bytes.len();
        }
    };
    let mut floats = |values: &[f64]| values.iter().for_each(|value| put(&(*value as f32).to_be_bytes()));
    match command {
        Command::Hello | Command::State | Command::Clear | Command::Stop => {}
        Command::Mode(mode) => put(&[*mode as u8]),
        Command::Enable(on) => put(&[u8::from(*on)]),
        Command::Move(speed, joints) => {
            floats(&[*speed]);
            floats(joints);
        }
        Command::Servo(joints) | Command::Velocity(joints) => floats(joints),
    }
    let header = [0xA5, command.sheet().0, number, (at - HEADER) as u8];
    frame.iter_mut().zip(header).for_each(|(to, byte)| *to = byte);
    let sum = sum(frame.get(..at).unwrap_or_default()).to_be_bytes();
    frame.iter_mut().skip(at).zip(sum).for_each(|(to, byte)| *to = byte);
    frame.get(..at + SUM).unwrap_or_default()
}

/// The checksum.
fn sum(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0, |sum, byte| sum.wrapping_add(u16::from(*byte)))
}

/// What the controller made of a command.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reply<'a> {
    /// 0 = done; [`status_text`] explains the others.
    pub status: u8,
    /// What follows the status.
    pub data: &'a [u8],
}

/// Finds the reply to a command at the front of `bytes`. Noise, damage and replies to other commands are skipped.
pub fn scan(bytes: &[u8], opcode: u8, number: u8) -> Scan<Reply<'_>> {
    let noise = bytes.iter().take_while(|byte| **byte != 0x5A).count();
    if noise > 0 {
        return Scan::Skip(noise);
    }
    let Some([_, code, n, length]) = bytes.first_chunk::<HEADER>() else { return Scan::More };
    let Some(frame) = bytes.get(..HEADER + usize::from(*length) + SUM) else { return Scan::More };
    let Some((body, check)) = frame.split_last_chunk::<SUM>() else { return Scan::More };
    if sum(body) != u16::from_be_bytes(*check) {
        return Scan::Skip(1);
    }
    match body.get(HEADER..).and_then(<[u8]>::split_first) {
        Some((status, data)) if (*code, *n) == (opcode, number) => {
            Scan::Take(frame.len(), Reply { status: *status, data })
        }
        _ => Scan::Skip(frame.len()),
    }
}

/// Status: refused because the controller is in error.
pub const IN_ERROR: u8 = 7;

/// Why the controller refused, in words.
pub fn status_text(status: u8) -> &'static str {
    match status {
        1 => "it does not know the command",
        2 => "a value is malformed",
        3 => "the motors are off",
        4 => "it is in another mode",
        5 => "the arm is moving",
        6 => "a target is outside the arm's limits",
        IN_ERROR => "it is in error",
        8 => "another client is connected to it",
        _ => "it gives a reason that the sheet does not list",
    }
}

/// What an error code means. YOUR ARM: every code of the manual, in the manual's words.
pub fn error_text(code: u16) -> &'static str {
    match code {
        0 => "",
        1 => "E-stop line open",
        2 => "collision detected",
        3 => "joint too hot",
        4 => "following error too large",
        _ => "an error that the sheet does not list",
    }
}

/// The reply to [`Command::Hello`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Hello {
    pub model: u16,
    pub dof: usize,
    pub firmware: (u8, u8),
    pub serial: u32,
}

impl Hello {
    /// Decodes the data of a good reply.
    pub fn decode(data: &[u8]) -> Option<Self> {
        let [m0, m1, dof, major, minor, serial @ ..] = *<&[u8; 9]>::try_from(data).ok()?;
        let serial = u32::from_be_bytes(serial);
        Some(Self { model: u16::from_be_bytes([m0, m1]), dof: dof.into(), firmware: (major, minor), serial })
    }
}

/// The reply to [`Command::State`]. All numbers are finite.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct State {
    /// Time of the measurement since power-up [µs].
    pub time_us: u64,
    pub enabled: bool,
    pub moving: bool,
    pub mode: Mode,
    /// The error; 0 = none.
    pub error: u16,
    /// [deg]
    pub positions: WireJoints,
    /// [deg/s]
    pub velocities: WireJoints,
    /// [Nm]
    pub torques: WireJoints,
}

impl State {
    /// Decodes the data of a good reply. `None` also when a number is not finite: such a packet is not to be trusted.
    pub fn decode(data: &[u8]) -> Option<Self> {
        let (time_us, data) = data.split_first_chunk()?;
        let ([flags, mode, e0, e1], data) = data.split_first_chunk()?;
        let (positions, data) = take_joints(data)?;
        let (velocities, data) = take_joints(data)?;
        let (torques, data) = take_joints(data)?;
        let mode = match mode {
            0 => Mode::Planned,
            1 => Mode::SetPoints,
            2 => Mode::Velocities,
            _ => return None,
        };
        data.is_empty().then_some(Self {
            time_us: u64::from_be_bytes(*time_us),
            enabled: flags & 1 != 0,
            moving: flags & 2 != 0,
            mode,
            error: u16::from_be_bytes([*e0, *e1]),
            positions,
            velocities,
            torques,
        })
    }
}

/// One finite float per joint from the front of `data`, and the rest.
fn take_joints(mut data: &[u8]) -> Option<(WireJoints, &[u8])> {
    let mut joints = [0.0; DOF];
    for joint in &mut joints {
        let (bytes, rest) = data.split_first_chunk()?;
        *joint = f64::from(f32::from_be_bytes(*bytes));
        data = rest;
    }
    joints.iter().all(|value| value.is_finite()).then_some((joints, data))
}

#[cfg(test)]
mod tests {
    use super::super::golden::{self, JOINTS, bytes};
    use super::*;

    #[test]
    fn commands_are_the_golden_bytes() {
        let joints = JOINTS.map(|(degrees, _)| degrees);
        let joints = *joints.first_chunk().unwrap();
        let mut frame = [0; MAX_COMMAND];
        for (command, number, golden) in [
            (Command::Hello, 1, bytes(golden::HELLO)),
            (Command::State, 2, bytes(golden::STATE)),
            (Command::Mode(Mode::SetPoints), 3, bytes(golden::MODE)),
            (Command::Enable(true), 4, bytes(golden::ENABLE)),
            (Command::Clear, 5, bytes(golden::CLEAR)),
            (Command::Stop, 255, bytes(golden::STOP)),
            (Command::Move(25.0, joints), 7, golden::of_joints("a51007", "41c80000", 1)),
            (Command::Servo(joints), 8, golden::of_joints("a51108", "", 1)),
            (Command::Velocity(joints), 9, golden::of_joints("a51209", "", 1)),
        ] {
            assert_eq!(encode(&command, number, &mut frame), golden, "{}", command.sheet().1);
        }
    }

    #[test]
    fn replies_are_read_from_the_golden_bytes() {
        let frame = bytes(golden::HELLO_REPLY);
        let Scan::Take(length, reply) = scan(&frame, 0x01, 1) else { panic!("no reply") };
        let hello = Hello { model: MODEL, dof: 6, firmware: (2, 1), serial: 42 };
        assert_eq!((length, Hello::decode(reply.data)), (frame.len(), Some(hello)));

        let frame = golden::of_joints("5a0202", golden::STATE_BEFORE_JOINTS, 3);
        let Scan::Take(_, reply) = scan(&frame, 0x02, 2) else { panic!("no reply") };
        let state = State::decode(reply.data).unwrap();
        assert_eq!((state.time_us, state.enabled, state.moving), (123_456_789, true, true));
        assert_eq!((state.mode, state.error), (Mode::SetPoints, 2));
        for joints in [state.positions, state.velocities, state.torques] {
            assert!(joints.iter().zip(JOINTS).all(|(found, (expected, _))| *found == expected), "{joints:?}");
        }
        let refusal = bytes(golden::MOVING_REPLY);
        assert_eq!(scan(&refusal, 0x03, 3), Scan::Take(refusal.len(), Reply { status: 5, data: &[] }));
    }

    #[test]
    fn noise_damage_and_foreign_replies_are_skipped() {
        let good = bytes(golden::MOVING_REPLY);
        assert_eq!(scan(&good, 0x03, 4), Scan::Skip(good.len()), "another number");
        assert_eq!(scan(&good, 0x04, 3), Scan::Skip(good.len()), "another command");
        assert_eq!(scan(b"noise\x5a", 0x03, 3), Scan::Skip(5));
        for i in 0..good.len() {
            assert_eq!(scan(&good[..i], 0x03, 3), Scan::More, "{i} bytes of a frame");
            let mut damaged = good.clone();
            damaged[i] ^= 0x10;
            assert!(!matches!(scan(&damaged, 0x03, 3), Scan::Take(..)), "byte {i} damaged");
        }
    }

    #[test]
    fn what_is_not_finite_or_not_whole_is_refused() {
        let frame = golden::of_joints("5a0202", golden::STATE_BEFORE_JOINTS, 3);
        let mut data = frame[5..frame.len() - 2].to_vec();
        assert!(State::decode(&data).is_some());
        assert!((0..data.len()).all(|length| State::decode(&data[..length]).is_none()));
        data[12..16].copy_from_slice(&f32::NAN.to_be_bytes());
        assert!(State::decode(&data).is_none(), "NaN");
    }
}
