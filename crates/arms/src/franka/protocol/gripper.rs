//! The hand: TCP port 1338 takes commands, and its state comes over UDP. The header of a command has 10 bytes (command
//! u16, number u32, whole length u32), the status of an answer 2.

use dimos_hardware::transport::Scan;

/// Version of the interface.
pub const VERSION: u16 = 3;
/// Length of a header [bytes].
const HEADER: usize = 10;
/// Length of a state [bytes].
pub const STATE: usize = 23;

/// A command.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Request {
    /// Begins the connection; the state is sent to this UDP port.
    Connect(u16),
    /// Closes to a width [m] at a speed [m/s], and holds what is in between with a force [N].
    Grasp(f64, f64, f64),
    /// Opens or closes to a width [m] at a speed [m/s].
    Move(f64, f64),
}

/// Tolerances of a grasp [m]: an object of any width counts.
const ANY_WIDTH: f64 = 0.1;

/// Encodes a command.
pub fn request(id: u32, request: Request) -> Vec<u8> {
    let floats = |values: &[f64]| -> Vec<u8> { values.iter().flat_map(|value| value.to_le_bytes()).collect() };
    let (code, values) = match request {
        Request::Connect(port) => (0_u16, [VERSION.to_le_bytes(), port.to_le_bytes()].concat()),
        Request::Grasp(width, speed, force) => (2, floats(&[width, ANY_WIDTH, ANY_WIDTH, speed, force])),
        Request::Move(width, speed) => (3, floats(&[width, speed])),
    };
    let length = (HEADER + values.len()) as u32;
    [&code.to_le_bytes()[..], &id.to_le_bytes(), &length.to_le_bytes(), &values].concat()
}

/// Finds the answer at the front of the received bytes: the number of its command, and the status.
pub fn scan(bytes: &[u8]) -> Scan<(u32, u16)> {
    let Some([_, _, a, b, c, d, e, f, g, h]) = bytes.first_chunk::<HEADER>().copied() else { return Scan::More };
    let length = u32::from_le_bytes([e, f, g, h]) as usize;
    if !(HEADER + 2..64).contains(&length) {
        return Scan::Skip(1);
    }
    match bytes.get(HEADER..length) {
        Some([low, high, ..]) => {
            Scan::Take(length, (u32::from_le_bytes([a, b, c, d]), u16::from_le_bytes([*low, *high])))
        }
        _ => Scan::More,
    }
}

/// Returns the width and the largest width of a state [m], and whether it holds an object. The largest width is 0
/// before the hand was homed.
pub fn state(bytes: &[u8]) -> Option<(f64, f64, bool)> {
    let number = |at: usize| bytes.get(at..).and_then(<[u8]>::first_chunk).map(|bytes| f64::from_le_bytes(*bytes));
    let values = (number(4)?, number(12)?, bytes.get(20).is_some_and(|grasped| *grasped != 0));
    (bytes.len() == STATE && values.0.is_finite() && values.1.is_finite()).then_some(values)
}
