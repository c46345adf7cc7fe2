//! The wire format of Feetech's STS servos: pure encoding and decoding, in the wire's own units (counts). No I/O here.
//!
//! ```text
//! instruction  FF FF | id | length | instruction | parameters | sum     length: of what follows it
//! status       FF FF | id | length | error       | data       | sum     sum: NOT of all bytes after FF FF
//! ```
//!
//! Numbers are little-endian; negative ones have a sign bit, no two's complement. Sources: the vendor's memory table of
//! the STS3215, and what its SDK 1.0.0 sends.

use dimos_hardware::transport::Scan;

/// Servos: five joints and the gripper, numbered in a row.
pub const SERVOS: usize = 6;
/// Counts of a turn of the output shaft.
pub const TURN: f64 = 4096.0;
/// The model that servos report: STS3215.
pub const MODEL: u16 = 777;
/// Number of all servos at once; they answer to a ping only.
pub const BROADCAST: u8 = 0xFE;
/// Longest instruction: seven registers of each servo, or a list of them.
pub const MAX_INSTRUCTION: usize = 8 + SERVOS * 8;
/// Most data of a status.
pub const MAX_DATA: usize = 32;

/// Registers.
pub mod register {
    /// Number of the servo.
    pub const ID: u8 = 5;
    /// Rate of the line: 0 is 1 Mbit/s.
    pub const RATE: u8 = 6;
    /// Lowest position, two bytes; the highest follows it.
    pub const RANGE: u8 = 9;
    /// Highest torque [0.1 %], two bytes; the torque limit has its value after power-up.
    pub const MAX_TORQUE: u8 = 16;
    /// Homing offset, two bytes with the sign in bit 11.
    pub const OFFSET: u8 = 31;
    /// Control mode: 0 is position. In another mode goals mean something else.
    pub const MODE: u8 = 33;
    /// Torque: 0 off, 1 on. The first of the state.
    pub const TORQUE: u8 = 40;
    /// Acceleration [100 counts/s²]; then the goal's position, time and velocity, two bytes each.
    pub const ACCELERATION: u8 = 41;
    /// Goal position, two bytes.
    pub const GOAL: u8 = 42;
    /// Velocity of the goal, two bytes: in position mode the top speed, 0 = none. The torque limit [0.1 %] follows it.
    pub const TOP_SPEED: u8 = 46;
    /// Torque limit [0.1 %], two bytes.
    pub const TORQUE_LIMIT: u8 = 48;
    /// Lock: while it is 1, writes to the EEPROM are lost at power-off.
    pub const LOCK: u8 = 55;
    /// Position, two bytes.
    pub const POSITION: u8 = 56;
}

/// Registers 40 to 70: all of a servo's state.
pub const STATE: (u8, u8) = (register::TORQUE, 31);

/// An instruction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Instruction<'a> {
    /// Is a servo there?
    Ping(u8),
    /// Reads registers of a servo: address, length.
    Read(u8, u8, u8),
    /// Writes registers of a servo: address, bytes.
    Write(u8, u8, &'a [u8]),
    /// Reads the same registers of all servos of an arm, of which the first has this number; each answers, in order.
    ReadAll(u8, u8, u8),
    /// Writes the same registers of all servos of an arm: the first number, address, bytes of one servo, those of all.
    /// No answer.
    WriteAll(u8, u8, u8, &'a [u8]),
}

/// Writes an instruction into `frame`; the result is the part that was written.
pub fn encode<'a>(instruction: Instruction<'_>, frame: &'a mut [u8; MAX_INSTRUCTION]) -> &'a [u8] {
    let mut at = 4;
    let mut put = |byte: u8| {
        if let Some(to) = frame.get_mut(at) {
            (*to, at) = (byte, at + 1);
        }
    };
    let ids = |first: u8| first..first + SERVOS as u8;
    let id = match instruction {
        Instruction::Ping(id) => {
            put(0x01);
            id
        }
        Instruction::Read(id, address, length) => {
            [0x02, address, length].into_iter().for_each(put);
            id
        }
        Instruction::Write(id, address, values) => {
            [0x03, address].iter().chain(values).copied().for_each(put);
            id
        }
        Instruction::ReadAll(first, address, length) => {
            [0x82, address, length].into_iter().chain(ids(first)).for_each(put);
            BROADCAST
        }
        Instruction::WriteAll(first, address, length, values) => {
            [0x83, address, length].into_iter().for_each(&mut put);
            for (id, values) in ids(first).zip(values.chunks(usize::from(length).max(1))) {
                put(id);
                values.iter().copied().for_each(&mut put);
            }
            BROADCAST
        }
    };
    let header = [0xFF, 0xFF, id, (at - 3) as u8];
    frame.iter_mut().zip(header).for_each(|(to, byte)| *to = byte);
    let sum = sum(frame.get(2..at).unwrap_or_default());
    if let Some(to) = frame.get_mut(at) {
        *to = sum;
    }
    frame.get(..=at).unwrap_or_default()
}

/// Returns the sum of the bytes after FF FF, as frames end with it.
pub(super) fn sum(bytes: &[u8]) -> u8 {
    !bytes.iter().fold(0u8, |sum, byte| sum.wrapping_add(*byte))
}

/// A servo's answer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Status<'a> {
    /// Its number.
    pub id: u8,
    /// Its error bits; 0 = none.
    pub error: u8,
    /// What was read.
    pub data: &'a [u8],
}

/// Finds the status of a servo from `ids` with this much data at the front of `bytes`. Noise, damage and everything
/// else is skipped.
pub fn scan(bytes: &[u8], ids: std::ops::RangeInclusive<u8>, data: usize) -> Scan<Status<'_>> {
    let noise = bytes.windows(2).position(|pair| pair == [0xFF, 0xFF]).unwrap_or(bytes.len().saturating_sub(1));
    if noise > 0 {
        return Scan::Skip(noise);
    }
    let Some([_, _, id, length]) = bytes.first_chunk::<4>() else { return Scan::More };
    // FF FF FF: the header begins a byte later.
    if !ids.contains(id) || usize::from(*length) != data + 2 {
        return Scan::Skip(1);
    }
    let Some(frame) = bytes.get(..data + 6) else { return Scan::More };
    match frame.get(2..).and_then(<[u8]>::split_last) {
        Some((check, [_, _, error, data @ ..])) if sum(frame.get(2..frame.len() - 1).unwrap_or_default()) == *check => {
            Scan::Take(frame.len(), Status { id: *id, error: *error, data })
        }
        _ => Scan::Skip(1),
    }
}

/// The word of a number with its sign in bit `bit`.
pub fn with_sign(value: i32, bit: u32) -> u16 {
    let size = value.unsigned_abs() as u16 & ((1 << bit) - 1);
    if value < 0 { size | 1 << bit } else { size }
}

/// A number with its sign in bit `bit`.
pub fn signed(word: u16, bit: u32) -> i32 {
    let sign = 1u16 << bit;
    let size = i32::from(word & !sign);
    if word & sign == 0 { size } else { -size }
}

/// The state of a servo.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Servo {
    /// Whether its motor is on.
    pub on: bool,
    /// Goal position [counts].
    pub goal: i32,
    /// Top speed [counts/s]; 0 = none.
    pub top_speed: u16,
    /// Torque limit [0.1 %].
    pub torque_limit: u16,
    /// Position [counts].
    pub position: i32,
    /// Velocity [counts/s].
    pub velocity: i32,
    /// Supply voltage [0.1 V].
    pub voltage: u8,
    /// Error bits; 0 = none.
    pub error: u8,
    /// Whether it moves.
    pub moving: bool,
    /// Duty cycle of the motor [0.1 %], signed.
    pub load: i32,
    /// Temperature [°C].
    pub temperature: u8,
    /// Motor current [6.5 mA].
    pub current: u16,
}

impl Servo {
    /// Decodes registers 40 to 70.
    pub fn decode(data: &[u8]) -> Option<Self> {
        let data = data.first_chunk::<{ STATE.1 as usize }>()?;
        let byte = |address: u8| data.get(usize::from(address - STATE.0)).copied().unwrap_or_default();
        let word = |address: u8| u16::from_le_bytes([byte(address), byte(address + 1)]);
        Some(Self {
            on: byte(40) == 1,
            goal: signed(word(42), 15),
            top_speed: word(register::TOP_SPEED),
            torque_limit: word(register::TORQUE_LIMIT),
            position: signed(word(56), 15),
            velocity: signed(word(58), 15),
            voltage: byte(62),
            error: byte(65),
            moving: byte(66) != 0,
            load: signed(word(60), 10),
            temperature: byte(63),
            current: word(69),
        })
    }
}

/// What error bits mean.
pub fn error_text(error: u8) -> &'static str {
    match error {
        0 => "",
        e if e & 0x20 != 0 => "overload",
        e if e & 0x08 != 0 => "overcurrent",
        e if e & 0x04 != 0 => "too hot",
        e if e & 0x02 != 0 => "angle sensor",
        e if e & 0x01 != 0 => "supply voltage out of range",
        _ => "an error that the manual does not list",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes(instruction: Instruction<'_>) -> Vec<u8> {
        encode(instruction, &mut [0; MAX_INSTRUCTION]).to_vec()
    }

    #[test]
    fn instructions_are_those_of_the_vendors_sdk() {
        assert_eq!(bytes(Instruction::Ping(1)), [0xFF, 0xFF, 0x01, 0x02, 0x01, 0xFB]);
        assert_eq!(bytes(Instruction::Read(1, 3, 2)), [0xFF, 0xFF, 0x01, 0x04, 0x02, 0x03, 0x02, 0xF3]);
        let all = [0xFF, 0xFF, 0xFE, 0x0A, 0x82, 0x38, 0x02, 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x26];
        assert_eq!(bytes(Instruction::ReadAll(1, 56, 2)), all);
        let goal = [0xFF, 0xFF, 0x01, 0x05, 0x03, 0x2A, 0x00, 0x08, 0xC4];
        assert_eq!(bytes(Instruction::Write(1, 42, &[0x00, 0x08])), goal);
        // The SDK writes two servos where this writes as many as there are values.
        let two = [0xFF, 0xFF, 0xFE, 0x0A, 0x83, 0x2A, 0x02, 0x01, 0x00, 0x08, 0x02, 0x00, 0x04, 0x39];
        assert_eq!(bytes(Instruction::WriteAll(1, 42, 2, &[0x00, 0x08, 0x00, 0x04])), two);
    }

    #[test]
    fn answers_are_found_among_noise_and_damage() {
        let one = [0xFF, 0xFF, 0x01, 0x04, 0x00, 0x00, 0x08, 0xF2];
        let six = [0xFF, 0xFF, 0x06, 0x04, 0x20, 0x00, 0x08, 0xCD];
        let take = |id, error| Scan::Take(8, Status { id, error, data: &[0x00, 0x08] });
        assert_eq!(scan(&one, 1..=6, 2), take(1, 0));
        assert_eq!(scan(&six, 1..=6, 2), take(6, 0x20));
        assert_eq!(scan(&one[..5], 1..=6, 2), Scan::More);
        assert_eq!(scan(&[0x12, 0x34, 0xFF, 0xFF, 0x01], 1..=6, 2), Scan::Skip(2));
        assert_eq!(scan(&one, 2..=6, 2), Scan::Skip(1), "another servo");
        assert_eq!(scan(&one, 1..=6, 15), Scan::Skip(1), "the answer to another request");
        let mut damaged = one;
        damaged[6] ^= 0x40;
        assert_eq!(scan(&damaged, 1..=6, 2), Scan::Skip(1));
        assert_eq!(scan(&[0xFF, 0xFF, 0xFF, 0x01, 0x04], 1..=6, 2), Scan::Skip(1));
    }

    #[test]
    fn signs_are_a_bit() {
        assert_eq!((signed(0x8005, 15), signed(5, 15), signed(0x864, 11)), (-5, 5, -100));
        assert_eq!((with_sign(-5, 15), with_sign(5, 15), with_sign(-100, 11)), (0x8005, 5, 0x864));
    }
}
