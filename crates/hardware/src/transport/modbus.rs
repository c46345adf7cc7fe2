//! A Modbus client: the registers of one device, over a line of bytes (RTU) or over Modbus TCP.
//!
//! Own code, 150 lines: `modbus-core` 0.2 panics on a partial TCP frame and finds no RTU request of function 16,
//! `rmodbus` lacks function 23 and reads a reply only if nothing precedes it, `tokio-modbus` needs a runtime.

use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::Scan;
use super::line::{Line, LineAddress};
use super::request_reply::{RequestReply, Retry};
use crate::adapter::{AdapterError, AdapterResult};

/// Most registers of one request.
pub const MOST: usize = 64;
/// Longest telegram of this client.
const LONGEST: usize = 2 * MOST + 16;
/// Function codes.
const READ_HOLDING: u8 = 3;
const READ_INPUT: u8 = 4;
const WRITE: u8 = 16;
/// Added to the function code of a reply that is an exception.
const EXCEPTION: u8 = 0x80;
/// Bytes before the unit in a telegram of Modbus TCP.
const HEADER: usize = 6;

/// How telegrams are framed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Framing {
    /// Modbus RTU, on a serial line or in a socket that carries the bytes of one.
    Rtu,
    /// Modbus TCP.
    Tcp,
}

impl Framing {
    /// Returns the framing at an address, unless one is given: Modbus TCP at `tcp:HOST:PORT`, RTU at any other.
    pub fn at(address: &LineAddress, given: Option<Self>) -> Self {
        given.unwrap_or(if matches!(address, LineAddress::Tcp(_)) { Self::Tcp } else { Self::Rtu })
    }
}

/// The two tables of registers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Table {
    /// Holding registers, which can also be written (function 3).
    #[default]
    Holding,
    /// Input registers (function 4).
    Input,
}

/// The checksum of RTU.
fn crc16(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0xFFFF, |crc, byte| {
        (0..8).fold(crc ^ u16::from(*byte), |crc, _| if crc & 1 == 1 { crc >> 1 ^ 0xA001 } else { crc >> 1 })
    })
}

/// What an exception code means.
fn meaning(code: u8) -> &'static str {
    match code {
        1 => "it has no such function",
        2 => "it has no such register",
        3 => "it does not take the value",
        4 => "the device failed",
        6 => "the device is busy",
        10 | 11 => "the gateway does not reach the device",
        _ => "an exception without a name",
    }
}

/// The reply to a request: of this unit, function and length.
#[derive(Debug, Clone, Copy)]
struct Expected {
    framing: Framing,
    number: u16,
    unit: u8,
    function: u8,
    /// Length from the function code on.
    length: usize,
}

impl Expected {
    /// Finds the reply at the front of `bytes`; `take` gets what follows the function code. An exception is its code.
    fn scan<T>(&self, bytes: &[u8], take: impl FnOnce(&[u8]) -> T) -> Scan<Result<T, u8>> {
        let (used, pdu) = match self.framing {
            Framing::Rtu => {
                let (Some(&unit), function) = (bytes.first(), bytes.get(1)) else { return Scan::More };
                let length = match function {
                    _ if unit != self.unit => return Scan::Skip(1),
                    None => return Scan::More,
                    Some(function) if *function == self.function => self.length,
                    Some(function) if *function == self.function | EXCEPTION => 2,
                    Some(_) => return Scan::Skip(1),
                };
                let Some((frame, crc)) = bytes.get(..length + 3).and_then(<[u8]>::split_last_chunk::<2>) else {
                    return Scan::More;
                };
                if crc16(frame) != u16::from_le_bytes(*crc) {
                    return Scan::Skip(1);
                }
                (length + 3, frame.get(1..).unwrap_or_default())
            }
            Framing::Tcp => {
                let Some(&[n0, n1, p0, p1, l0, l1]) = bytes.first_chunk::<HEADER>() else { return Scan::More };
                let length = usize::from(u16::from_be_bytes([l0, l1]));
                if (p0, p1) != (0, 0) || !(3..=254).contains(&length) {
                    return Scan::Skip(1);
                }
                let Some(frame) = bytes.get(HEADER..HEADER + length) else { return Scan::More };
                let is_ours = u16::from_be_bytes([n0, n1]) == self.number && frame.first() == Some(&self.unit);
                if !is_ours {
                    return Scan::Skip(HEADER + length);
                }
                (HEADER + length, frame.get(1..).unwrap_or_default())
            }
        };
        match pdu {
            [function, rest @ ..] if *function == self.function && pdu.len() == self.length => {
                Scan::Take(used, Ok(take(rest)))
            }
            [function, code] if *function == self.function | EXCEPTION => Scan::Take(used, Err(*code)),
            _ => Scan::Skip(used),
        }
    }
}

/// A device as its Modbus client sees it.
#[derive(Debug)]
pub struct ModbusClient {
    line: RequestReply<Line>,
    /// The device, for messages.
    device: String,
    unit: u8,
    framing: Framing,
    retry: Retry,
    number: u16,
}

impl ModbusClient {
    /// Creates the client of the device with the number `unit`; `device` names it in messages. A request is made as
    /// `retry` says: registers may be written twice.
    pub fn new(device: impl Into<String>, unit: u8, framing: Framing, retry: Retry) -> Self {
        Self { line: RequestReply::half_duplex(false), device: device.into(), unit, framing, retry, number: 0 }
    }

    /// Opens the line. Does not show whether the device is there.
    pub fn connect(&mut self, address: &LineAddress, timeout: Duration) -> AdapterResult<()> {
        self.line.open(Line::connect(&self.device, address, timeout)?);
        Ok(())
    }

    /// Closes the line.
    pub fn close(&mut self) {
        self.line.close();
    }

    /// Returns whether the line is open, as far as known: several missing replies in a row close it.
    pub fn is_open(&self) -> bool {
        self.line.is_open()
    }

    /// Sends bytes that are no telegram, such as those that end a stream. No answer is awaited.
    pub fn send(&mut self, bytes: &[u8]) -> AdapterResult<()> {
        self.line.tell(bytes)
    }

    /// Reads registers of a table from `first` on, at most [`MOST`]. `Rejected` if the device answers with an
    /// exception.
    pub fn read(&mut self, table: Table, first: u16, into: &mut [u16]) -> AdapterResult<()> {
        let function = if table == Table::Input { READ_INPUT } else { READ_HOLDING };
        let count = into.len();
        self.request(function, first, count, &[], 2 + 2 * count, |reply| {
            let values = reply.get(1..).unwrap_or_default().chunks_exact(2);
            into.iter_mut().zip(values).for_each(|(value, bytes)| {
                *value = bytes.first_chunk().map_or(0, |bytes| u16::from_be_bytes(*bytes));
            });
        })
    }

    /// Writes holding registers from `first` on, at most [`MOST`]. `Rejected` if the device answers with an exception.
    pub fn write(&mut self, first: u16, values: &[u16]) -> AdapterResult<()> {
        self.request(WRITE, first, values.len(), values, 5, |_| ())
    }

    fn request(
        &mut self,
        function: u8,
        first: u16,
        count: usize,
        values: &[u16],
        length: usize,
        mut take: impl FnMut(&[u8]),
    ) -> AdapterResult<()> {
        if count == 0 || count > MOST {
            return Err(AdapterError::Rejected(format!("{}: {count} registers at once, not 1 to {MOST}", self.device)));
        }
        self.number = self.number.wrapping_add(1);
        let mut frame = Vec::with_capacity(LONGEST);
        if self.framing == Framing::Tcp {
            let data = if values.is_empty() { 0 } else { 1 + 2 * values.len() };
            frame.extend([self.number.to_be_bytes(), [0, 0], (6 + data as u16).to_be_bytes()].concat());
        }
        frame.extend([self.unit, function]);
        frame.extend(first.to_be_bytes());
        frame.extend((count as u16).to_be_bytes());
        if !values.is_empty() {
            frame.push(2 * values.len() as u8);
            frame.extend(values.iter().flat_map(|value| value.to_be_bytes()));
        }
        if self.framing == Framing::Rtu {
            frame.extend(crc16(&frame).to_le_bytes());
        }
        let expected = Expected { framing: self.framing, number: self.number, unit: self.unit, function, length };
        match self.line.request(&frame, self.retry, |bytes| expected.scan(bytes, &mut take))? {
            Ok(()) => Ok(()),
            Err(code) => Err(AdapterError::Rejected(format!(
                "{} refused to {} register {first}: {} (exception {code})",
                self.device,
                if function == WRITE { "write" } else { "read" },
                meaning(code)
            ))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn expected(framing: Framing, function: u8, length: usize) -> Expected {
        Expected { framing, number: 0x1234, unit: 9, function, length }
    }

    /// The example of the gripper's manual: its status and position.
    const REPLY: [u8; 11] = [9, 4, 6, 0x31, 0, 0, 0xFF, 0xBD, 0, 0x44, 0x00];

    fn framed(mut bytes: Vec<u8>) -> Vec<u8> {
        bytes.extend(crc16(&bytes).to_le_bytes());
        bytes
    }

    #[test]
    fn the_checksum_is_that_of_the_protocol() {
        assert_eq!(crc16(&[1, 3, 8, 0x2B, 0, 2]).to_le_bytes(), [0xB6, 0x63]);
        // Requests in the manuals of Robotiq's grippers and sensors.
        assert_eq!(crc16(&[9, 0x10, 3, 0xE8, 0, 3, 6, 1, 0, 0, 0, 0, 0]).to_le_bytes(), [0x72, 0xE1]);
        assert_eq!(crc16(&[9, 3, 0, 0xB4, 0, 6]).to_le_bytes(), [0x84, 0xA6]);
    }

    #[test]
    fn a_reply_is_found_among_noise_and_in_pieces() {
        let want = expected(Framing::Rtu, READ_INPUT, 8);
        let good = framed(REPLY[..9].to_vec());
        for end in 1..good.len() {
            assert_eq!(want.scan(&good[..end], <[u8]>::to_vec), Scan::More, "{end} bytes");
        }
        assert_eq!(want.scan(&good, |rest| rest[0]), Scan::Take(11, Ok(6)));
        let mut damaged = good.clone();
        damaged[4] ^= 1;
        for bytes in [&damaged[..], &[8, 4], &[9, 3]] {
            assert_eq!(want.scan(bytes, <[u8]>::to_vec), Scan::Skip(1), "{bytes:?}");
        }
        assert_eq!(want.scan(&framed(vec![9, 0x84, 2]), <[u8]>::to_vec), Scan::Take(5, Err(2)));
    }

    #[test]
    fn over_tcp_the_number_tells_replies_apart() {
        let want = expected(Framing::Tcp, WRITE, 5);
        let reply = |number: u8| vec![0x12, number, 0, 0, 0, 6, 9, 16, 3, 0xE8, 0, 3];
        assert_eq!(want.scan(&reply(0x34), <[u8]>::to_vec), Scan::Take(12, Ok(vec![3, 0xE8, 0, 3])));
        assert_eq!(want.scan(&reply(0x33), <[u8]>::to_vec), Scan::Skip(12), "a late one");
        assert_eq!(want.scan(&reply(0x34)[..11], <[u8]>::to_vec), Scan::More);
        assert_eq!(want.scan(&[0x12, 0x34, 0, 7, 0, 6, 9], <[u8]>::to_vec), Scan::Skip(1), "another protocol");
        let refused = [0x12, 0x34, 0, 0, 0, 3, 9, 0x90, 2];
        assert_eq!(want.scan(&refused, <[u8]>::to_vec), Scan::Take(9, Err(2)));
    }
}
