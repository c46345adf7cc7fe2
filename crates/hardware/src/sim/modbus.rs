//! A Modbus server for emulated devices. It shares no code with the client: two sides that share an encoder share its
//! mistakes.

use crate::transport::Scan;
use crate::transport::modbus::Framing;
use dimos_core::clock::Mono;

/// Exception codes.
pub const NO_FUNCTION: u8 = 1;
/// No such register.
pub const NO_REGISTER: u8 = 2;
/// A value that is not taken.
pub const NO_VALUE: u8 = 3;
/// Most registers of one request.
const MOST: u16 = 125;

/// The registers of an emulated device.
pub trait Registers {
    /// Reads `count` registers from `first` on, of the input registers or the holding ones, or returns an exception
    /// code.
    fn read(&mut self, input: bool, first: u16, count: u16, now: Mono) -> Result<Vec<u16>, u8>;
    /// Writes holding registers from `first` on, or returns an exception code.
    fn write(&mut self, first: u16, values: &[u16], now: Mono) -> Result<(), u8>;
}

/// Answers the request at the front of `bytes` if it is complete and for `unit`. Puts the response into `answer`.
pub fn serve(
    framing: Framing,
    unit: u8,
    bytes: &[u8],
    now: Mono,
    device: &mut impl Registers,
    answer: &mut Vec<u8>,
) -> Scan<()> {
    match framing {
        Framing::Rtu => {
            let [number, function, ..] = bytes else { return Scan::More };
            let length = match function {
                3 | 4 | 6 => 6,
                16 => match bytes.get(6) {
                    Some(data) => 7 + usize::from(*data),
                    None => return Scan::More,
                },
                23 => match bytes.get(10) {
                    Some(data) => 11 + usize::from(*data),
                    None => return Scan::More,
                },
                // A pause would show where it ends; here it is taken to be all that has arrived.
                _ => bytes.len().saturating_sub(2).max(2),
            };
            let Some(frame) = bytes.get(..length + 2) else { return Scan::More };
            let (body, sum) = frame.split_at(length);
            if checksum(body) != sum {
                return Scan::Skip(1);
            }
            if *number == unit {
                let reply = respond(body.get(1..).unwrap_or_default(), now, device);
                answer.push(unit);
                answer.extend(reply);
                let sum = checksum(answer);
                answer.extend(sum);
            }
            Scan::Take(length + 2, ())
        }
        Framing::Tcp => {
            let Some((header, rest)) = bytes.split_first_chunk::<7>() else { return Scan::More };
            let [n0, n1, _, _, l0, l1, number] = *header;
            let length = usize::from(u16::from_be_bytes([l0, l1])).saturating_sub(1);
            let Some(body) = rest.get(..length) else { return Scan::More };
            if number == unit {
                let reply = respond(body, now, device);
                answer.extend([n0, n1, 0, 0]);
                answer.extend((1 + reply.len() as u16).to_be_bytes());
                answer.push(unit);
                answer.extend(reply);
            }
            Scan::Take(7 + length, ())
        }
    }
}

/// Returns the response to a request without its frame.
fn respond(request: &[u8], now: Mono, device: &mut impl Registers) -> Vec<u8> {
    let function = request.first().copied().unwrap_or_default();
    execute(request, now, device).unwrap_or_else(|code| vec![function | 0x80, code])
}

fn execute(request: &[u8], now: Mono, device: &mut impl Registers) -> Result<Vec<u8>, u8> {
    let word = |at: usize| match request.get(at..at + 2) {
        Some([high, low]) => Ok(u16::from(*high) * 256 + u16::from(*low)),
        _ => Err(NO_VALUE),
    };
    let words =
        |bytes: &[u8]| bytes.chunks(2).map(|pair| pair.iter().fold(0, |v, b| v * 256 + u16::from(*b))).collect();
    let read = |device: &mut dyn FnMut(u16, u16) -> Result<Vec<u16>, u8>, first: u16, count: u16, function: u8| {
        if count == 0 || count > MOST {
            return Err(NO_VALUE);
        }
        let values = device(first, count)?;
        let mut reply = vec![function, 2 * count as u8];
        reply.extend(values.iter().flat_map(|value| [(value / 256) as u8, (value % 256) as u8]));
        Ok(reply)
    };
    match request.first() {
        Some(function @ (3 | 4)) => {
            let input = *function == 4;
            read(&mut |first, count| device.read(input, first, count, now), word(1)?, word(3)?, *function)
        }
        Some(6) => {
            device.write(word(1)?, &[word(3)?], now)?;
            Ok(request.to_vec())
        }
        Some(16) => {
            let values: Vec<u16> = words(request.get(6..).unwrap_or_default());
            if values.len() != usize::from(word(3)?) {
                return Err(NO_VALUE);
            }
            device.write(word(1)?, &values, now)?;
            Ok(request.get(..5).unwrap_or_default().to_vec())
        }
        Some(23) => {
            let values: Vec<u16> = words(request.get(10..).unwrap_or_default());
            if values.len() != usize::from(word(7)?) {
                return Err(NO_VALUE);
            }
            device.write(word(5)?, &values, now)?;
            read(&mut |first, count| device.read(false, first, count, now), word(1)?, word(3)?, 23)
        }
        _ => Err(NO_FUNCTION),
    }
}

/// The checksum of RTU by its definition: division of the bits by x^16 + x^15 + x^2 + 1, the lowest bit first.
fn checksum(bytes: &[u8]) -> [u8; 2] {
    let mut rest = 0xFFFF_u16;
    for bit in bytes.iter().flat_map(|byte| (0..8).map(move |i| u16::from(byte >> i & 1))) {
        let carry = (rest & 1) ^ bit;
        rest = rest >> 1 ^ if carry == 1 { 0xA001 } else { 0 };
    }
    rest.to_le_bytes()
}
