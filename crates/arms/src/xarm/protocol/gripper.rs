//! The grippers at the tool flange: Modbus-RTU telegrams (without checksum) that the controller passes on, and what
//! their pulses mean.
//!
//! | gripper | opening | pulses |
//! |---|---|---|
//! | xArm Gripper | 0 to 0.085 m | 10 000 per metre: 850 = open. The fingers swing, so the opening between them is only nominally this |
//! | xArm Gripper G2 | 0 to 0.084 m | 18.28 per degree of the finger's angle; opening [mm] = 16 + 110 · sin(angle − 8.33°) |

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::take;

/// The gripper's number on the tool's bus.
const SLAVE: u8 = 8;
const READ: u8 = 3;
const WRITE: u8 = 16;

const ENABLE: u16 = 0x0100;
const MODE: u16 = 0x0101;
const SPEED: u16 = 0x0303;
const TARGET: u16 = 0x0700;
const POSITION: u16 = 0x0702;
const ERROR: u16 = 0x000F;
const CLEAR: u16 = 0x0109;
const MOVE_G2: u16 = 0x0C00;

/// Speed of an xArm Gripper for a command without a speed, and the largest [rpm of its motor].
const SPEED_G1: f64 = 2000.0;
const TOP_SPEED_G1: f64 = 5000.0;
/// Speed of a G2 for a command without a speed, the smallest and the largest of the vendor's SDK [mm/s].
const SPEED_G2: f64 = 100.0;
const SPEED_RANGE_G2: (f64, f64) = (15.0, 225.0);
/// Force of a G2 for a command without a force, as the vendor's SDK has it; the smallest and the largest force [%].
pub const FORCE_G2: u16 = 50;
/// See [`FORCE_G2`].
pub const FORCE_RANGE_G2: (f64, f64) = (1.0, 100.0);

/// The register of the tool board that holds its baud rate, and the index of 2 Mbit/s, which the grippers need.
pub const BAUD_REGISTER: u16 = 0x0A0B;
/// See [`BAUD_REGISTER`].
pub const BAUD_INDEX: i32 = 11;

/// Registers of the tool board: its inputs, what sets one of its outputs, and what its outputs are.
pub const INPUTS: u16 = 0x0A14;
/// See [`INPUTS`].
pub const SET_OUTPUTS: u16 = 0x0A15;
/// See [`INPUTS`].
pub const OUTPUTS: u16 = 0x0A18;

/// The value that sets output 0 or 1 of the tool board: which one is meant in the upper byte, its level in the lower.
pub fn set_output(output: u8, high: bool) -> u16 {
    (0x0100 | u16::from(high)) << output
}

/// The grippers at the tool flange.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum GripperKind {
    /// None is used.
    #[default]
    None,
    /// xArm Gripper.
    Xarm,
    /// xArm Gripper G2.
    XarmG2,
    /// The Lite 6's own gripper, which only opens and closes.
    Lite6,
    /// The vacuum gripper.
    Vacuum,
}

impl GripperKind {
    /// Returns whether it only opens and closes, by outputs of the tool board.
    pub fn is_on_off(self) -> bool {
        matches!(self, Self::Lite6 | Self::Vacuum)
    }

    /// Position when it is open [m], or 1 of one that only opens and closes; `None` without gripper.
    pub fn widest(self) -> Option<f64> {
        match self {
            Self::None => None,
            Self::Lite6 | Self::Vacuum => Some(1.0),
            Self::Xarm => Some(0.085),
            Self::XarmG2 => Some(0.084),
        }
    }

    /// The pulses of an opening [m].
    pub fn pulses(self, opening: f64) -> i32 {
        let millimetres = opening * 1000.0;
        let pulses = match self {
            Self::XarmG2 => (((millimetres - 16.0) / 110.0).asin().to_degrees() + 8.33) * 18.28,
            _ => millimetres * 10.0,
        };
        (pulses.round() as i32).max(0) // closed is 0; rounding alone would make it −1 for a G2
    }

    /// The opening [m] of pulses.
    pub fn opening(self, pulses: i32) -> f64 {
        let millimetres = match self {
            Self::XarmG2 => (f64::from(pulses) / 18.28 - 8.33).to_radians().sin() * 110.0 + 16.0,
            _ => f64::from(pulses) / 10.0,
        };
        millimetres / 1000.0
    }
}

/// A telegram to the gripper.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rtu {
    bytes: [u8; 24],
    length: usize,
}

impl Rtu {
    fn new(function: u8, address: u16, registers: u16) -> Self {
        let mut telegram = Self { bytes: [0; 24], length: 0 };
        telegram.put(&[SLAVE, function]);
        telegram.put(&address.to_be_bytes());
        telegram.put(&registers.to_be_bytes());
        telegram
    }

    fn write(address: u16, data: &[u8]) -> Self {
        let mut telegram = Self::new(WRITE, address, (data.len() / 2) as u16);
        telegram.put(&[data.len() as u8]);
        telegram.put(data);
        telegram
    }

    fn put(&mut self, bytes: &[u8]) {
        if let Some(to) = self.bytes.get_mut(self.length..self.length + bytes.len()) {
            to.copy_from_slice(bytes);
            self.length += bytes.len();
        }
    }

    /// Its bytes.
    pub fn bytes(&self) -> &[u8] {
        self.bytes.get(..self.length).unwrap_or_default()
    }

    /// Motor on.
    pub fn enable() -> Self {
        Self::write(ENABLE, &1_u16.to_be_bytes())
    }

    /// Goes to positions.
    pub fn position_mode() -> Self {
        Self::write(MODE, &0_u16.to_be_bytes())
    }

    /// Sets the speed of an xArm Gripper, a fraction of its largest.
    pub fn speed(fraction: Option<f64>) -> Self {
        let rpm = fraction.map_or(SPEED_G1, |fraction| (fraction * TOP_SPEED_G1).clamp(1.0, TOP_SPEED_G1));
        Self::write(SPEED, &(rpm.round() as u16).to_be_bytes())
    }

    /// Moves to a position [pulses], a G2 with this largest force [%] and a fraction of its largest speed.
    pub fn go(kind: GripperKind, pulses: i32, force: u16, speed: Option<f64>) -> Self {
        let [a, b, c, d] = pulses.to_be_bytes();
        match kind {
            GripperKind::XarmG2 => {
                let (least, most) = SPEED_RANGE_G2;
                let speed = speed.map_or(SPEED_G2, |fraction| (fraction * most).clamp(least, most));
                // From mm/s, as the vendor's SDK converts it.
                let speed = ((speed * 60.0 / 9.88235 + 140.0) / 0.4).round() as u16;
                let ([s0, s1], [f0, f1]) = (speed.to_be_bytes(), force.to_be_bytes());
                Self::write(MOVE_G2, &[0, 1, s0, s1, f0, f1, a, b, c, d])
            }
            _ => Self::write(TARGET, &[a, b, c, d]),
        }
    }

    /// Asks where it is.
    pub fn read_position() -> Self {
        Self::new(READ, POSITION, 2)
    }

    /// Asks for its error.
    pub fn read_error() -> Self {
        Self::new(READ, ERROR, 1)
    }

    /// Clears its error.
    pub fn clear_error() -> Self {
        Self::write(CLEAR, &1_u16.to_be_bytes())
    }

    /// Whether this is the gripper's good answer to the telegram: after the state byte the bus number, then the
    /// answer. The data of a read are handed out.
    pub fn answered<'a>(&self, answer: &'a [u8]) -> Option<&'a [u8]> {
        let [_, function, ..] = self.bytes() else { return None };
        match answer {
            [_bus, SLAVE, code, length, data @ ..] if code == function && *function == READ => {
                data.get(..usize::from(*length))
            }
            [_bus, SLAVE, code, ..] if code == function => Some(&[]),
            _ => None,
        }
    }
}

/// Pulses in the data of a read of the position.
pub fn decode_position(data: &[u8]) -> Option<i32> {
    take::bytes(data, 0).map(i32::from_be_bytes)
}

/// The code in the data of a read of the error.
pub fn decode_error(data: &[u8]) -> Option<u16> {
    take::bytes(data, 0).map(u16::from_be_bytes)
}
