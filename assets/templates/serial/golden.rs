//! Frames written down by hand from the sheet. Adapter and emulator are both tested against them, so that a mistake
//! which both sides share still shows.
//!
//! YOUR ARM: take them from the manual's examples, or record what the vendor's own program sends and gets.

use super::SERVOS;

/// HELLO to servo 3.
pub const HELLO: &str = "a5 03 01 00 a9";
/// STATE of all servos.
pub const STATE: &str = "a5 00 02 00 a7";
/// MOTORS on.
pub const MOTORS: &str = "a5 00 03 01 01 aa";
/// GOALS of servo 3 alone: 2048, no top speed.
pub const GOAL: &str = "a5 03 04 04 0800 0000 b8";
/// CLEAR.
pub const CLEAR: &str = "a5 00 05 00 aa";

/// Reply of servo 3 to [`HELLO`]: model 1, firmware 2.3.
pub const HELLO_REPLY: &str = "5a 03 00 04 0001 02 03 67";
/// Reply of servo 2 to [`STATE`]: overload, motor on, moving, at 2048, -100 counts/s, goal 2000.
pub const STATE_REPLY: &str = "5a 02 01 07 03 0800 ff9c 07d0 e1";

/// Goals of the servos, and the same on the wire with the top speed 500.
pub const GOALS: [(i32, &str); 17] = [
    (2048, "0800 01f4"),
    (1, "0001 01f4"),
    (4095, "0fff 01f4"),
    (256, "0100 01f4"),
    (1000, "03e8 01f4"),
    (3000, "0bb8 01f4"),
    (2000, "07d0 01f4"),
    (300, "012c 01f4"),
    (400, "0190 01f4"),
    (500, "01f4 01f4"),
    (600, "0258 01f4"),
    (700, "02bc 01f4"),
    (800, "0320 01f4"),
    (900, "0384 01f4"),
    (1100, "044c 01f4"),
    (1200, "04b0 01f4"),
    (1300, "0514 01f4"),
];

/// Bytes written as hexadecimal digits.
pub fn bytes(hex: &str) -> Vec<u8> {
    let hex = hex.replace(' ', "");
    (0..hex.len()).step_by(2).map(|i| u8::from_str_radix(&hex[i..i + 2], 16).unwrap()).collect()
}

/// GOALS of as many servos as there are.
pub fn goals() -> Vec<u8> {
    let payload = bytes(&GOALS.iter().take(SERVOS).map(|(_, hex)| *hex).collect::<String>());
    let mut frame = bytes("a5 00 04");
    frame.push(payload.len().try_into().unwrap());
    frame.extend(payload);
    let sum: u32 = frame.iter().map(|byte| u32::from(*byte)).sum();
    frame.push((sum % 256) as u8);
    frame
}
