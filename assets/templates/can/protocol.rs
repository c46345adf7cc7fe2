//! The frames: pure encoding and decoding, in the wire's own units (0.001 deg, 0.001 deg/s). No I/O here.
//!
//! YOUR ARM: this sheet is made up, in the way most arms on CAN speak. Write down the vendor's here, and then change the
//! code below to match it.
//!
//! ```text
//! The arm streams, 200 times a second, in this order. All numbers are big-endian.
//! 2A0 + n   positions of joints 2n+1 and 2n+2, i32 [0.001 deg] each; a joint that is not there is 0
//! 2B0 + n   velocities of the same, i32 [0.001 deg/s] each
//! 2C0       flags u8 (1 motors on, 2 moving), mode u8, error u16, 0 0 0 0
//! 2D0       only when asked: model u8, joints u8, firmware major u8, minor u8, serial number u32
//!
//! Commands. Nothing is acknowledged: what became of them shows in 2C0.
//! 150       01 on   0 motors off, 1 on (the arm holds where it is)
//!           02 mode speed   0 planned, 1 setpoints; speed of planned moves [%]; the mode changes at a standstill only
//!           03      clears the error
//!           04      stops: decelerates; the motors stay on
//!           05      asks for 2D0
//! 160 + n   targets of joints 2n+1 and 2n+2, i32 [0.001 deg] each; the arm acts when the last pair has come
//!
//! error     0 none, 1 E-stop line open, 2 collision, 3 joint too hot, 4 following error
//! ```

use dimos_hardware::transport::can::{CanFilter, CanFrame};

use super::DOF;

/// What the arm says its model is.
pub const MODEL: u8 = 1; // YOUR ARM

/// Number of frames that hold a value for each joint.
pub const PAIRS: usize = DOF.div_ceil(2);

const POSITIONS: u16 = 0x2A0;
const VELOCITIES: u16 = 0x2B0;
const STATUS: u16 = 0x2C0;
const IDENTITY: u16 = 0x2D0;
const CONTROL: u16 = 0x150;
const TARGETS: u16 = 0x160;

/// What the adapter wants to hear: everything that the arm sends; and its own commands, which are so followed until they
/// are transmitted.
pub const FILTERS: &[CanFilter] = &[
    CanFilter { id: POSITIONS, mask: 0x7F0 },
    CanFilter { id: VELOCITIES, mask: 0x7F0 },
    CanFilter { id: STATUS, mask: 0x7FF },
    CanFilter { id: IDENTITY, mask: 0x7FF },
    CanFilter { id: CONTROL, mask: 0x7FF },
    CanFilter { id: TARGETS, mask: 0x7F0 },
];

/// One value per joint, in wire units.
pub type WireJoints = [i32; DOF];

/// The arm's modes, with their numbers on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(u8)]
pub enum Mode {
    #[default]
    Planned = 0,
    SetPoints = 1,
}

/// A frame of id 150.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Control {
    Enable(bool),
    /// With the speed of planned moves [%].
    Mode(Mode, u8),
    Clear,
    Stop,
    Identify,
}

impl Control {
    /// The frame of this command.
    pub fn encode(&self) -> CanFrame {
        let [what, first, second] = match *self {
            Self::Enable(on) => [0x01, u8::from(on), 0],
            Self::Mode(mode, speed) => [0x02, mode as u8, speed],
            Self::Clear => [0x03, 0, 0],
            Self::Stop => [0x04, 0, 0],
            Self::Identify => [0x05, 0, 0],
        };
        CanFrame::new(CONTROL, &[what, first, second, 0, 0, 0, 0, 0])
    }
}

/// The frames that send the joints to `targets` [0.001 deg].
pub fn encode_targets(targets: &WireJoints) -> [CanFrame; PAIRS] {
    let value = |joint: usize| targets.get(joint).copied().unwrap_or_default().to_be_bytes();
    std::array::from_fn(|n| {
        let ([a, b, c, d], [e, f, g, h]) = (value(2 * n), value(2 * n + 1));
        CanFrame::new(TARGETS + n as u16, &[a, b, c, d, e, f, g, h])
    })
}

/// What a frame of the arm says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Feedback {
    /// Number of the pair, and its positions [0.001 deg].
    Positions(usize, [i32; 2]),
    /// Number of the pair, and its velocities [0.001 deg/s].
    Velocities(usize, [i32; 2]),
    Status(Status),
    Identity(Identity),
}

/// How the arm is. It comes last in a round of frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Status {
    pub enabled: bool,
    pub moving: bool,
    pub mode: Mode,
    /// 0 = none.
    pub error: u16,
}

/// Who the arm is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Identity {
    pub model: u8,
    pub dof: usize,
    pub firmware: (u8, u8),
    pub serial: u32,
}

/// Reads a frame; `None` for one that is not on the sheet.
pub fn decode(frame: &CanFrame) -> Option<Feedback> {
    let data = <[u8; 8]>::try_from(frame.bytes()).ok()?;
    let [a, b, c, d, e, f, g, h] = data;
    let pair = [i32::from_be_bytes([a, b, c, d]), i32::from_be_bytes([e, f, g, h])];
    let number = usize::from(frame.id & 0x00F);
    match frame.id & 0x7F0 {
        POSITIONS if number < PAIRS => Some(Feedback::Positions(number, pair)),
        VELOCITIES if number < PAIRS => Some(Feedback::Velocities(number, pair)),
        STATUS if number == 0 => {
            let mode = match b {
                0 => Mode::Planned,
                1 => Mode::SetPoints,
                _ => return None,
            };
            let error = u16::from_be_bytes([c, d]);
            Some(Feedback::Status(Status { enabled: a & 1 != 0, moving: a & 2 != 0, mode, error }))
        }
        IDENTITY if number == 0 => {
            let serial = u32::from_be_bytes([e, f, g, h]);
            Some(Feedback::Identity(Identity { model: a, dof: b.into(), firmware: (c, d), serial }))
        }
        _ => None,
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

#[cfg(test)]
mod tests {
    use super::super::golden::{self, JOINTS, frame};
    use super::*;

    #[test]
    fn commands_are_the_golden_bytes() {
        for (control, golden) in [
            (Control::Enable(true), golden::ENABLE),
            (Control::Mode(Mode::SetPoints, 25), golden::MODE),
            (Control::Clear, golden::CLEAR),
            (Control::Stop, golden::STOP),
            (Control::Identify, golden::IDENTIFY),
        ] {
            assert_eq!(control.encode(), frame(golden), "{control:?}");
        }
        let targets: WireJoints = std::array::from_fn(|joint| JOINTS[joint].0);
        assert_eq!(encode_targets(&targets).to_vec(), golden::of_joints(0x160));
    }

    #[test]
    fn feedback_is_read_from_the_golden_bytes() {
        let status = Status { enabled: true, moving: true, mode: Mode::SetPoints, error: 2 };
        assert_eq!(decode(&frame(golden::STATUS)), Some(Feedback::Status(status)));
        let identity = Identity { model: MODEL, dof: 6, firmware: (2, 1), serial: 42 };
        assert_eq!(decode(&frame(golden::IDENTITY)), Some(Feedback::Identity(identity)));
        for (n, frame) in golden::of_joints(0x2A0).iter().enumerate() {
            let Some(Feedback::Positions(number, pair)) = decode(frame) else { panic!("{frame:?}") };
            let last = if 2 * n + 1 < DOF { JOINTS[2 * n + 1].0 } else { 0 };
            assert_eq!((number, pair), (n, [JOINTS[2 * n].0, last]));
        }
        assert!(golden::of_joints(0x2B0).iter().all(|f| matches!(decode(f), Some(Feedback::Velocities(..)))));
    }

    #[test]
    fn what_is_not_on_the_sheet_is_nothing() {
        let status = frame(golden::STATUS);
        assert!((0..8).all(|len| decode(&CanFrame::new(status.id, &status.bytes()[..len])).is_none()), "too short");
        assert_eq!(decode(&CanFrame { id: 0x2C1, ..status }), None);
        assert_eq!(decode(&CanFrame { id: 0x2A0 + PAIRS as u16, ..status }), None, "a pair that is not there");
        assert_eq!(decode(&CanFrame::new(status.id, &[3, 2, 0, 0, 0, 0, 0, 0])), None, "mode 2");
    }
}
