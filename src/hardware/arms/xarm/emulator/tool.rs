//! What is at the tool flange: the tool board, and a gripper behind its RS485 that speaks Modbus-RTU.

use super::super::protocol::gripper::GripperKind;
use crate::hardware::sim::faults::{Fault, FaultKind};
use crate::hardware::sim::gripper::Gripper;

/// Index of 2 Mbit/s among the baud rates.
const TWO_MBIT: i32 = 11;
/// Nominal speed of the fingers at the largest speed of their motor [m/s], and that speed in the units of each
/// gripper's telegrams.
const TOP_SPEED: f64 = 0.25;
const FASTEST_G1: f64 = 5000.0;
const FASTEST_G2: f64 = 3765.0;
/// The gripper's version.
const VERSION: [u16; 3] = [3, 4, 3];

/// The tool flange.
pub struct Tool {
    kind: GripperKind,
    gripper: Gripper,
    baud: i32,
    enabled: bool,
    speed: u16,
    /// Opening that a telegram has just ordered [m].
    order: Option<f64>,
    /// The gripper's error.
    pub error: u16,
}

impl Tool {
    /// A flange with this gripper, half open.
    pub fn new(kind: GripperKind) -> Self {
        let gripper = Gripper::new(kind.widest().unwrap_or(0.0), TOP_SPEED);
        Self { kind, gripper, baud: TWO_MBIT, enabled: false, speed: 1500, order: None, error: 0 }
    }

    /// Plays the faults of the gripper that are due.
    pub fn play(&mut self, take: impl FnMut(FaultKind) -> Option<Fault>) {
        self.gripper.play(take);
    }

    /// Lets `dt` [s] pass.
    pub fn advance(&mut self, dt: f64) {
        self.gripper.advance(dt);
    }

    /// Shows the gripper of an arm that has its own: its opening [m], and whether it moves.
    pub fn show(&mut self, opening: f64, moving: bool) {
        self.gripper.position = opening;
        if !moving {
            self.gripper.stop();
        }
    }

    /// Takes the opening that a telegram has ordered [m].
    pub fn take_order(&mut self) -> Option<f64> {
        self.order.take()
    }

    /// The gripper's opening [m].
    pub fn opening(&self) -> f64 {
        self.gripper.position
    }

    /// Largest force that a G2 was given [%]; `None` for another gripper.
    pub fn force(&self) -> Option<f64> {
        (self.kind == GripperKind::XarmG2).then_some(self.gripper.max_force)
    }

    /// Reads a register of the tool board.
    pub fn read(&self, register: u16) -> i32 {
        if register & 0x0FFF == 0x0A0B { self.baud } else { 0 }
    }

    /// Writes a register of the tool board.
    pub fn write(&mut self, register: u16, value: f32) {
        if register & 0x0FFF == 0x0A0B {
            self.baud = value as i32;
        }
    }

    /// Returns the answer to a telegram; `None` if no device answers.
    pub fn telegram(&mut self, telegram: &[u8]) -> Option<Vec<u8>> {
        if self.kind == GripperKind::None || self.baud != TWO_MBIT {
            return None;
        }
        match *telegram {
            [8, 3, a0, a1, _, count] if count <= 16 => {
                let first = u16::from_be_bytes([a0, a1]);
                let registers = (0..u16::from(count)).flat_map(|i| self.holding(first.wrapping_add(i)).to_be_bytes());
                Some([8, 3, 2 * count].into_iter().chain(registers).collect())
            }
            [8, 16, a0, a1, c0, c1, _, ref data @ ..] => {
                self.set(u16::from_be_bytes([a0, a1]), data);
                Some(vec![8, 16, a0, a1, c0, c1])
            }
            _ => None,
        }
    }

    fn pulses(&self) -> i32 {
        let millimetres = self.gripper.position * 1000.0;
        match self.kind {
            GripperKind::XarmG2 => ((((millimetres - 16.0) / 110.0).asin().to_degrees() + 8.33) * 18.28) as i32,
            _ => (millimetres * 10.0).round() as i32,
        }
    }

    fn holding(&self, register: u16) -> u16 {
        let [high, low] = [self.pulses() >> 16, self.pulses()].map(|value| value as u16);
        match register {
            0x0000 if self.gripper.gripping() => 2,
            0x0000 => u16::from(self.gripper.moving()),
            0x000F => self.error,
            0x0100 => u16::from(self.enabled),
            0x0303 => self.speed,
            0x0702 => high,
            0x0703 => low,
            0x0801..=0x0803 => VERSION.get(usize::from(register - 0x0801)).copied().unwrap_or_default(),
            _ => 0,
        }
    }

    fn set(&mut self, register: u16, data: &[u8]) {
        match (register, data) {
            (0x0100, [_, on]) => self.enabled = *on == 1,
            (0x0303, [high, low]) => self.speed = u16::from_be_bytes([*high, *low]),
            (0x0109, _) => self.error = 0,
            (0x0700, [a, b, c, d]) => {
                self.go(i32::from_be_bytes([*a, *b, *c, *d]), f64::from(self.speed) / FASTEST_G1);
            }
            (0x0C00, [_, on, s0, s1, f0, f1, a, b, c, d]) => {
                self.enabled |= *on == 1;
                let speed = f64::from(u16::from_be_bytes([*s0, *s1])) / FASTEST_G2;
                self.gripper.max_force = u16::from_be_bytes([*f0, *f1]).into();
                self.go(i32::from_be_bytes([*a, *b, *c, *d]), speed);
            }
            _ => {}
        }
    }

    fn go(&mut self, pulses: i32, speed: f64) {
        if !self.enabled || self.error != 0 {
            return;
        }
        let millimetres = match self.kind {
            GripperKind::XarmG2 => (f64::from(pulses) / 18.28 - 8.33).to_radians().sin() * 110.0 + 16.0,
            _ => f64::from(pulses) / 10.0,
        };
        self.gripper.set_speed(speed);
        self.order = Some(millimetres / 1000.0);
        self.gripper.move_to(millimetres / 1000.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_read_beyond_the_last_register_is_answered() {
        let answer = Tool::new(GripperKind::Xarm).telegram(&[8, 3, 0xFF, 0xFF, 0, 2]);
        assert_eq!(answer, Some(vec![8, 3, 4, 0, 0, 0, 0]));
    }
}
