//! What is at the tool flange: the tool board, and a gripper behind its RS485 that speaks Modbus-RTU.

use super::super::protocol::gripper::GripperKind;
use dimos_hardware::sim::faults::{Fault, FaultKind};
use dimos_hardware::sim::gripper::Gripper;
use dimos_hardware::sim::tool_device::ToolSocket;

/// Rates of the line [bit/s], in the order of their numbers.
const RATES: [u32; 13] = [
    4_800, 9_600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 921_600, 1_000_000, 1_500_000, 2_000_000,
    2_500_000,
];
/// Index of 2 Mbit/s among them.
const TWO_MBIT: i32 = 11;
/// Nominal speed of the fingers at the largest speed of their motor [m/s], and that speed in the units of each
/// gripper's telegrams.
const TOP_SPEED: f64 = 0.25;
/// Part of its way that a gripper without positions makes in a second.
const ON_OFF_SPEED: f64 = 3.0;
const FASTEST_G1: f64 = 5000.0;
const FASTEST_G2: f64 = 3765.0;
/// Register of the baud rate, and of the restart.
const BAUD: u16 = 0x0A0B;
const REBOOT: u16 = 0x0607;
/// The gripper's number on the bus.
const SLAVE: u8 = 8;
/// How far beyond its range a target may be [mm]: the vendor's range is -10 to 850 pulses.
const MARGIN: f64 = 1.0;
/// The gripper's version.
const VERSION: [u16; 3] = [3, 4, 3];
/// The outputs that the tool board has.
const ALL_OUTPUTS: u16 = 0x001F;

/// The tool flange.
pub struct Tool {
    kind: GripperKind,
    gripper: Gripper,
    baud: i32,
    enabled: bool,
    speed: u16,
    /// Whether a client has set the speed.
    speed_set: bool,
    /// Opening that a telegram has just ordered [m], and the fraction of the top speed that was set.
    order: Option<(f64, Option<f64>)>,
    /// Levels of the outputs.
    outputs: u16,
    /// The gripper's error.
    pub error: u16,
    /// Another device at the line.
    pub socket: ToolSocket,
}

impl Tool {
    /// A flange with this gripper, half open.
    pub fn new(kind: GripperKind) -> Self {
        let speed = if kind.is_on_off() { ON_OFF_SPEED } else { TOP_SPEED };
        Self {
            kind,
            gripper: Gripper::new(kind.widest().unwrap_or(0.0), speed),
            baud: TWO_MBIT,
            enabled: false,
            speed: 1500,
            speed_set: false,
            order: None,
            outputs: 0,
            error: 0,
            socket: ToolSocket::default(),
        }
    }

    /// Passes bytes to the device at the line, and returns what comes back.
    pub fn pass(&mut self, bytes: &[u8]) -> Vec<u8> {
        let mut answer = Vec::new();
        let rate = usize::try_from(self.baud).ok().and_then(|index| RATES.get(index));
        if let Some(rate) = rate {
            self.socket.exchange(*rate, bytes, &mut answer);
        }
        answer
    }

    /// Returns the answer of that device to a telegram of Modbus RTU, to which the box adds the checksum.
    pub fn pass_modbus(&mut self, telegram: &[u8]) -> Option<Vec<u8>> {
        let check = |bytes: &[u8]| {
            bytes.iter().fold(0xFFFF_u16, |sum, byte| {
                (0..8).fold(sum ^ u16::from(*byte), |sum, _| if sum & 1 == 0 { sum >> 1 } else { (sum >> 1) ^ 0xA001 })
            })
        };
        let answer = self.pass(&[telegram, &check(telegram).to_le_bytes()].concat());
        let (data, sum) = answer.split_last_chunk::<2>()?;
        (check(data).to_le_bytes() == *sum).then(|| data.to_vec())
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

    /// Takes the opening that a telegram has ordered [m], and the fraction of the top speed if one was set.
    pub fn take_order(&mut self) -> Option<(f64, Option<f64>)> {
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

    /// Reads a register of the tool board: the baud rate, and inputs and outputs; `None` for another.
    pub fn read(&self, register: u16) -> Option<i32> {
        match register & 0x0FFF {
            BAUD => Some(self.baud),
            0x0A14 => Some((self.kind == GripperKind::Vacuum && self.gripper.gripping()).into()),
            0x0A18 => Some(self.outputs.into()),
            0x0A12..=0x0A17 => Some(0),
            _ => None,
        }
    }

    /// Writes a register of the tool board. `None` if nothing was written; `settable`: the baud rate can be changed.
    pub fn write(&mut self, register: u16, value: f32, settable: bool) -> Option<()> {
        match register & 0x0FFF {
            BAUD if settable => self.baud = value as i32,
            BAUD if value as i32 == self.baud => {}
            // The upper byte says which outputs are meant, the lower one their levels.
            0x0A15 if settable => self.set_outputs(value as u16),
            // Its restart changes nothing here.
            REBOOT if settable && value == 1.0 => {}
            _ => return None,
        }
        Some(())
    }

    fn set_outputs(&mut self, value: u16) {
        let meant = (value >> 8) & ALL_OUTPUTS;
        self.outputs = (self.outputs & !meant) | (value & meant);
        // Both off: the Lite 6's fingers rest, and a vacuum gripper does as before.
        let opens = match (self.kind, self.outputs & 3) {
            (GripperKind::Lite6, 1) | (GripperKind::Vacuum, 2) => true,
            (GripperKind::Lite6, 2) | (GripperKind::Vacuum, 1) => false,
            (GripperKind::Lite6, _) => return self.gripper.stop(),
            _ => return,
        };
        self.gripper.move_to(f64::from(opens));
    }

    /// Returns whether a device answers telegrams like this one.
    pub fn hears(&self, telegram: &[u8]) -> bool {
        self.kind != GripperKind::None
            && !self.kind.is_on_off()
            && self.baud == TWO_MBIT
            && telegram.first() == Some(&SLAVE)
    }

    /// Returns the answer to a telegram; `None` for one that the gripper does not know or execute.
    pub fn telegram(&mut self, telegram: &[u8]) -> Option<Vec<u8>> {
        if !self.hears(telegram) {
            return None;
        }
        match *telegram {
            [SLAVE, 3, a0, a1, _, count] if count <= 16 => {
                let first = u16::from_be_bytes([a0, a1]);
                let registers = (0..u16::from(count)).flat_map(|i| self.holding(first.wrapping_add(i)).to_be_bytes());
                Some([SLAVE, 3, 2 * count].into_iter().chain(registers).collect())
            }
            [SLAVE, 16, a0, a1, c0, c1, _, ref data @ ..] => {
                self.set(u16::from_be_bytes([a0, a1]), data)?;
                Some(vec![SLAVE, 16, a0, a1, c0, c1])
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

    /// Writes a register. `None` if nothing came of it: vendors' clients take any answer for a success.
    fn set(&mut self, register: u16, data: &[u8]) -> Option<()> {
        match (register, self.kind, data) {
            (0x0100, _, [_, on @ 0..=1]) => self.enabled = *on == 1,
            (0x0101, _, [0, 0]) => {} // the position mode: it has no other
            (0x0303, GripperKind::Xarm, [high, low]) => {
                (self.speed, self.speed_set) = (u16::from_be_bytes([*high, *low]), true);
            }
            (0x0109, ..) => self.error = 0,
            (0x0700, GripperKind::Xarm, [a, b, c, d]) => {
                self.go(i32::from_be_bytes([*a, *b, *c, *d]), f64::from(self.speed) / FASTEST_G1)?;
            }
            (0x0C00, GripperKind::XarmG2, [_, on, s0, s1, f0, f1, a, b, c, d]) => {
                self.enabled |= *on == 1;
                let speed = f64::from(u16::from_be_bytes([*s0, *s1])) / FASTEST_G2;
                self.gripper.max_force = u16::from_be_bytes([*f0, *f1]).into();
                self.go(i32::from_be_bytes([*a, *b, *c, *d]), speed)?;
            }
            _ => return None,
        }
        Some(())
    }

    fn go(&mut self, pulses: i32, speed: f64) -> Option<()> {
        if self.error != 0 {
            return Some(()); // the client reads the error next
        }
        let millimetres = match self.kind {
            GripperKind::XarmG2 => (f64::from(pulses) / 18.28 - 8.33).to_radians().sin() * 110.0 + 16.0,
            _ => f64::from(pulses) / 10.0,
        };
        let widest = self.kind.widest()? * 1000.0;
        if !self.enabled || !(-MARGIN..=widest + MARGIN).contains(&millimetres) {
            return None;
        }
        self.gripper.set_speed(speed);
        self.order = Some((millimetres / 1000.0, self.speed_set.then_some(speed)));
        self.gripper.move_to(millimetres / 1000.0);
        Some(())
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
