//! Frames written down by hand from the sheet. Adapter and emulator are both tested against them, so that a mistake
//! which both sides share still shows.
//!
//! YOUR ARM: take them from the manual's examples, or record what the vendor's own program sends and gets.

use super::DOF;

/// HELLO.
pub const HELLO: &str = "aa 01 00 54";
/// STATE.
pub const STATE: &str = "aa 02 00 53";
/// MODE set points.
pub const MODE: &str = "aa 03 01 01 50";
/// ENABLE on.
pub const ENABLE: &str = "aa 04 01 01 4f";
/// CLEAR.
pub const CLEAR: &str = "aa 05 00 50";
/// STOP.
pub const STOP: &str = "aa 06 00 4f";

/// Reply to [`HELLO`]: model 1, 6 joints, firmware 2.1, serial number 42.
pub const HELLO_REPLY: &str = "55 01 09 00 01 06 02 01 2a000000 6c";
/// Refusal of [`MODE`]: the arm is moving.
pub const MOVING_REPLY: &str = "55 03 01 05 a1";
/// What stands before the joints in the reply to [`STATE`]: done, 123.456 s, motors on, moving, set points, error 2.
pub const STATE_BEFORE_JOINTS: &str = "00 40e20100 03 01 0200";

/// Values of the joints [0.001 deg], and the same on the wire.
pub const JOINTS: [(i32, &str); 16] = [
    (10_000, "10270000"),
    (-20_000, "e0b1ffff"),
    (30_000, "30750000"),
    (-40_000, "c063ffff"),
    (50_000, "50c30000"),
    (-60_000, "a015ffff"),
    (70_000, "70110100"),
    (-80_000, "80c7feff"),
    (90_000, "905f0100"),
    (-100_000, "6079feff"),
    (110_000, "b0ad0100"),
    (-120_000, "402bfeff"),
    (130_000, "d0fb0100"),
    (-140_000, "20ddfdff"),
    (150_000, "f0490200"),
    (-160_000, "008ffdff"),
];

/// Bytes written as hexadecimal digits.
pub fn bytes(hex: &str) -> Vec<u8> {
    let hex = hex.replace(' ', "");
    (0..hex.len()).step_by(2).map(|i| u8::from_str_radix(&hex[i..i + 2], 16).unwrap()).collect()
}

/// A frame that carries, behind `before`, the values of all joints so many times.
pub fn of_joints(header: &str, before: &str, times: usize) -> Vec<u8> {
    let joints = JOINTS.iter().take(DOF).map(|(_, number)| *number).collect::<String>().repeat(times);
    let payload = bytes(&format!("{before}{joints}"));
    let mut frame = bytes(header);
    frame.push(payload.len().try_into().unwrap());
    frame.extend(payload);
    let sum: u32 = frame.iter().map(|byte| u32::from(*byte)).sum();
    frame.push(255 - (sum % 256) as u8);
    frame
}
