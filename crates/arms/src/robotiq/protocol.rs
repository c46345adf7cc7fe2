//! Registers of the two-finger grippers, as their manual has them: two bytes each, the higher one first.

use dimos_hardware::peripheral::Condition;

/// First of the three holding registers that are written: action request, position, speed and force.
pub const ACTION: u16 = 1000;
/// First of the three input registers: status, fault and echo of the position, position and current.
pub const STATUS: u16 = 2000;

/// Bits of the action request: activate, and go to the requested position.
const ACTIVATE: u16 = 0x01 << 8;
const GO: u16 = 0x08 << 8;

/// Returns the registers that move the fingers to `count` with a speed and a force of 0 to 255.
pub fn go(count: u8, speed: u8, force: u8) -> [u16; 3] {
    [ACTIVATE | GO, count.into(), u16::from_be_bytes([speed, force])]
}

/// The registers that end activation: the fingers stop where they are.
pub const RESET: [u16; 3] = [0; 3];
/// The registers that begin it.
pub const BEGIN: [u16; 3] = [ACTIVATE, 0, 0];

/// How the fingers are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fingers {
    /// On the way to the requested position.
    Moving,
    /// Stopped by something while they opened.
    StoppedOpening,
    /// Stopped by something while they closed.
    StoppedClosing,
    /// At the requested position.
    Arrived,
}

/// What the gripper reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Status {
    /// Whether activation was requested.
    pub active: bool,
    /// Whether it goes to positions.
    pub goes: bool,
    /// Progress of activation: 0 none, 1 under way, 3 done.
    pub activation: u8,
    /// How the fingers are.
    pub fingers: Fingers,
    /// Fault code; 0 = none.
    pub fault: u8,
    /// The requested position, 0 to 255.
    pub requested: u8,
    /// The position, 0 open to 255 closed.
    pub position: u8,
    /// Current of the motor [10 mA].
    pub current: u8,
}

impl Status {
    /// Reads the three input registers.
    pub fn of(registers: [u16; 3]) -> Self {
        let [[status, _], [fault, requested], [position, current]] = registers.map(u16::to_be_bytes);
        Self {
            active: status & 0x01 != 0,
            goes: status & 0x08 != 0,
            activation: status >> 4 & 0x03,
            fingers: match status >> 6 {
                0 => Fingers::Moving,
                1 => Fingers::StoppedOpening,
                2 => Fingers::StoppedClosing,
                _ => Fingers::Arrived,
            },
            fault: fault & 0x0F,
            requested,
            position,
            current,
        }
    }

    /// Returns whether it can be used.
    pub fn condition(&self) -> Condition {
        match (self.fault, self.activation) {
            (8 | 10..=15, _) => Condition::Fault(self.fault.into(), fault_text(self.fault)),
            _ if !self.active => Condition::NotHomed,
            (_, 3) => Condition::Ready,
            (_, 1) => Condition::Homing,
            _ => Condition::NotHomed,
        }
    }
}

/// Returns what a fault code means.
pub fn fault_text(code: u8) -> &'static str {
    match code {
        5 => "the action waits for the end of activation",
        7 => "it must be activated before the action",
        8 => "it is too hot",
        9 => "no telegram came for a second",
        10 => "its supply is below 21.6 V",
        11 => "it releases automatically",
        12 => "internal fault; contact the maker",
        13 => "activation failed: something is in the way of its fingers",
        14 => "too much current",
        15 => "it has released automatically",
        _ => "unknown",
    }
}
