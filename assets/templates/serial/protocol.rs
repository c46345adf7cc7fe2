//! The wire format: pure encoding and decoding, in the wire's own units (0.001 deg, 0.001 deg/s, ms). No I/O here.
//!
//! YOUR ARM: this sheet is made up, in the way most controllers on a serial line speak. Write down the vendor's here, and
//! then change the code below to match it.
//!
//! ```text
//! The controller speaks when it is spoken to. All numbers are little-endian; joints are i32.
//! command  AA | opcode | length | payload         | check
//! reply    55 | opcode | length | status, payload | check      check: u8, the inverse of the sum of all bytes before it
//!
//! 01 HELLO     –                          → model u8, joints u8, firmware major u8, minor u8, serial number u32
//! 02 STATE     –                          → time u32 [ms], flags u8 (1 motors on, 2 moving), mode u8, error u16,
//!                                           positions [0.001 deg], velocities [0.001 deg/s]: a number per joint
//! 03 MODE      0 planned, 1 set points, 2 velocities; refused while the arm moves
//! 04 ENABLE    0 motors off, 1 on (the arm holds where it is)
//! 05 CLEAR     –   clears the error
//! 06 STOP      –   decelerates; the motors stay on
//! 10 MOVE      speed u8 [%], target [0.001 deg] per joint
//! 11 SERVO     next set point [0.001 deg] per joint
//! 12 VELOCITY  [0.001 deg/s] per joint; the arm stops when no other follows within 200 ms
//!
//! status  0 done, 1 unknown, 2 malformed, 3 motors off, 4 wrong mode, 5 moving, 6 out of range, 7 in error
//! error   0 none, 1 E-stop line open, 2 collision, 3 joint too hot, 4 following error
//! ```

use std::fmt;

use dimos::hardware::transport::serial::Scan;

use super::DOF;

/// Rate of the line where an address names none [bit/s].
pub const BAUD: u32 = 1_000_000; // YOUR ARM
/// What the controller says its model is.
pub const MODEL: u8 = 1; // YOUR ARM

/// Bytes before the payload, and after it.
const HEADER: usize = 3;
const CHECK: usize = 1;
/// Room for the longest command.
pub const MAX_COMMAND: usize = HEADER + 1 + 4 * DOF + CHECK;

/// The serial line of an arm: `/dev/ttyUSB0`, `/dev/ttyUSB0@115200`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Line {
    pub path: String,
    /// [bit/s]
    pub baud: u32,
}

impl Line {
    /// Reads an address; what is wrong with it, in a sentence without full stop.
    pub fn parse(address: &str) -> Result<Self, String> {
        let (path, baud) = match address.rsplit_once('@') {
            None => (address, BAUD),
            Some((path, rate)) => match rate.parse() {
                Ok(baud @ 1200..=4_000_000) => (path, baud),
                _ => return Err(format!("{rate:?} is not a rate (1200 to 4000000 bit/s)")),
            },
        };
        if !path.starts_with('/') || path.ends_with('/') {
            return Err(format!("{path:?} is not the path of a serial device, such as /dev/ttyUSB0"));
        }
        Ok(Self { path: path.to_owned(), baud })
    }
}

impl fmt::Display for Line {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}@{}", self.path, self.baud)
    }
}

/// One value per joint, in wire units.
pub type WireJoints = [i32; DOF];

/// What the controller can be asked.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Command {
    Hello,
    State,
    Mode(Mode),
    Enable(bool),
    Clear,
    Stop,
    /// Speed [%], target [0.001 deg].
    Move(u8, WireJoints),
    /// Set point [0.001 deg].
    Servo(WireJoints),
    /// Velocities [0.001 deg/s].
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
pub fn encode<'a>(command: &Command, frame: &'a mut [u8; MAX_COMMAND]) -> &'a [u8] {
    let mut at = HEADER;
    let mut put = |bytes: &[u8]| {
        if let Some(to) = frame.get_mut(at..at + bytes.len()) {
            to.copy_from_slice(bytes);
            at += bytes.len();
        }
    };
    match command {
        Command::Hello | Command::State | Command::Clear | Command::Stop => {}
        Command::Mode(mode) => put(&[*mode as u8]),
        Command::Enable(on) => put(&[u8::from(*on)]),
        Command::Move(speed, joints) => {
            put(&[*speed]);
            joints.iter().for_each(|value| put(&value.to_le_bytes()));
        }
        Command::Servo(joints) | Command::Velocity(joints) => {
            joints.iter().for_each(|value| put(&value.to_le_bytes()));
        }
    }
    let header = [0xAA, command.sheet().0, (at - HEADER) as u8];
    frame.iter_mut().zip(header).for_each(|(to, byte)| *to = byte);
    let check = check(frame.get(..at).unwrap_or_default());
    frame.iter_mut().skip(at).take(CHECK).for_each(|to| *to = check);
    frame.get(..at + CHECK).unwrap_or_default()
}

/// The checksum.
fn check(bytes: &[u8]) -> u8 {
    !bytes.iter().fold(0_u8, |sum, byte| sum.wrapping_add(*byte))
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
pub fn scan(bytes: &[u8], opcode: u8) -> Scan<Reply<'_>> {
    let noise = bytes.iter().take_while(|byte| **byte != 0x55).count();
    if noise > 0 {
        return Scan::Skip(noise);
    }
    let Some([_, code, length]) = bytes.first_chunk::<HEADER>() else { return Scan::More };
    let Some(frame) = bytes.get(..HEADER + usize::from(*length) + CHECK) else { return Scan::More };
    let Some((last, body)) = frame.split_last() else { return Scan::More };
    if check(body) != *last {
        return Scan::Skip(1);
    }
    match body.get(HEADER..).and_then(<[u8]>::split_first) {
        Some((status, data)) if *code == opcode => Scan::Take(frame.len(), Reply { status: *status, data }),
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
    pub model: u8,
    pub dof: usize,
    pub firmware: (u8, u8),
    pub serial: u32,
}

impl Hello {
    /// Decodes the data of a good reply.
    pub fn decode(data: &[u8]) -> Option<Self> {
        let [model, dof, major, minor, serial @ ..] = *<&[u8; 8]>::try_from(data).ok()?;
        Some(Self { model, dof: dof.into(), firmware: (major, minor), serial: u32::from_le_bytes(serial) })
    }
}

/// The reply to [`Command::State`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct State {
    /// Time of the measurement since power-up [ms].
    pub time_ms: u32,
    pub enabled: bool,
    pub moving: bool,
    pub mode: Mode,
    /// The error; 0 = none.
    pub error: u16,
    /// [0.001 deg]
    pub positions: WireJoints,
    /// [0.001 deg/s]
    pub velocities: WireJoints,
}

impl State {
    /// Decodes the data of a good reply.
    pub fn decode(data: &[u8]) -> Option<Self> {
        let (time_ms, data) = data.split_first_chunk()?;
        let ([flags, mode, e0, e1], data) = data.split_first_chunk()?;
        let (positions, data) = take_joints(data)?;
        let (velocities, data) = take_joints(data)?;
        let mode = match mode {
            0 => Mode::Planned,
            1 => Mode::SetPoints,
            2 => Mode::Velocities,
            _ => return None,
        };
        data.is_empty().then_some(Self {
            time_ms: u32::from_le_bytes(*time_ms),
            enabled: flags & 1 != 0,
            moving: flags & 2 != 0,
            mode,
            error: u16::from_le_bytes([*e0, *e1]),
            positions,
            velocities,
        })
    }
}

/// One number per joint from the front of `data`, and the rest.
fn take_joints(mut data: &[u8]) -> Option<(WireJoints, &[u8])> {
    let mut joints = [0; DOF];
    for joint in &mut joints {
        let (bytes, rest) = data.split_first_chunk()?;
        *joint = i32::from_le_bytes(*bytes);
        data = rest;
    }
    Some((joints, data))
}

#[cfg(test)]
mod tests {
    use super::super::golden::{self, JOINTS, bytes};
    use super::*;

    #[test]
    fn commands_are_the_golden_bytes() {
        let joints: WireJoints = std::array::from_fn(|joint| JOINTS[joint].0);
        let mut frame = [0; MAX_COMMAND];
        for (command, golden) in [
            (Command::Hello, bytes(golden::HELLO)),
            (Command::State, bytes(golden::STATE)),
            (Command::Mode(Mode::SetPoints), bytes(golden::MODE)),
            (Command::Enable(true), bytes(golden::ENABLE)),
            (Command::Clear, bytes(golden::CLEAR)),
            (Command::Stop, bytes(golden::STOP)),
            (Command::Move(25, joints), golden::of_joints("aa10", "19", 1)),
            (Command::Servo(joints), golden::of_joints("aa11", "", 1)),
            (Command::Velocity(joints), golden::of_joints("aa12", "", 1)),
        ] {
            assert_eq!(encode(&command, &mut frame), golden, "{}", command.sheet().1);
        }
    }

    #[test]
    fn replies_are_read_from_the_golden_bytes() {
        let frame = bytes(golden::HELLO_REPLY);
        let Scan::Take(length, reply) = scan(&frame, 0x01) else { panic!("no reply") };
        let hello = Hello { model: MODEL, dof: 6, firmware: (2, 1), serial: 42 };
        assert_eq!((length, Hello::decode(reply.data)), (frame.len(), Some(hello)));

        let frame = golden::of_joints("5502", golden::STATE_BEFORE_JOINTS, 2);
        let Scan::Take(_, reply) = scan(&frame, 0x02) else { panic!("no reply") };
        let state = State::decode(reply.data).unwrap();
        assert_eq!((state.time_ms, state.enabled, state.moving), (123_456, true, true));
        assert_eq!((state.mode, state.error), (Mode::SetPoints, 2));
        for joints in [state.positions, state.velocities] {
            assert!(joints.iter().zip(JOINTS).all(|(found, (expected, _))| *found == expected), "{joints:?}");
        }
        assert!((0..reply.data.len()).all(|length| State::decode(&reply.data[..length]).is_none()), "not whole");
        let refusal = bytes(golden::MOVING_REPLY);
        assert_eq!(scan(&refusal, 0x03), Scan::Take(refusal.len(), Reply { status: 5, data: &[] }));
    }

    #[test]
    fn noise_damage_and_foreign_replies_are_skipped() {
        let good = bytes(golden::MOVING_REPLY);
        assert_eq!(scan(&good, 0x04), Scan::Skip(good.len()), "another command");
        assert_eq!(scan(b"noise\x55", 0x03), Scan::Skip(5));
        for i in 0..good.len() {
            assert_eq!(scan(&good[..i], 0x03), Scan::More, "{i} bytes of a frame");
            let mut damaged = good.clone();
            damaged[i] ^= 0x10;
            assert!(!matches!(scan(&damaged, 0x03), Scan::Take(..)), "byte {i} damaged");
        }
    }

    #[test]
    fn addresses() {
        let full = |address| Line::parse(address).map(|line| line.to_string());
        assert_eq!(full("/dev/ttyUSB0"), Ok(format!("/dev/ttyUSB0@{BAUD}")));
        assert_eq!(full("/dev/ttyUSB0@115200"), Ok("/dev/ttyUSB0@115200".into()));
        for bad in ["", "ttyUSB0", "/dev/", "/dev/ttyUSB0@", "/dev/ttyUSB0@fast", "/dev/ttyUSB0@0"] {
            assert!(Line::parse(bad).is_err(), "{bad:?}");
        }
    }
}
