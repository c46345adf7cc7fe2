//! Frames written down by hand from the sheet. Adapter and emulator are both tested against them, so that a mistake
//! which both sides share still shows.
//!
//! YOUR ARM: take them from the manual's examples, or record what the vendor's own program sends and gets.

use super::DOF;

/// HELLO, number 1.
pub const HELLO: &str = "a5010100 00a7";
/// STATE, number 2.
pub const STATE: &str = "a5020200 00a9";
/// MODE setpoints, number 3.
pub const MODE: &str = "a5030301 01 00ad";
/// ENABLE on, number 4.
pub const ENABLE: &str = "a5040401 01 00af";
/// CLEAR, number 5.
pub const CLEAR: &str = "a5050500 00af";
/// STOP, number 255.
pub const STOP: &str = "a506ff00 01aa";

/// Reply to [`HELLO`]: model 1, 6 joints, firmware 2.1, serial number 42.
pub const HELLO_REPLY: &str = "5a01010a 00 0001 06 0201 0000002a 009a";
/// Refusal of [`MODE`]: the arm is moving.
pub const MOVING_REPLY: &str = "5a030301 05 0066";
/// The part before the joints in the reply to [`STATE`]: done, 123.456789 s, motors on, moving, setpoints, error 2.
pub const STATE_BEFORE_JOINTS: &str = "00 00000000075bcd15 03 01 0002";

/// Values of the joints, and the same as floats of the wire.
pub const JOINTS: [(f64, &str); 16] = [
    (10.0, "41200000"),
    (-20.0, "c1a00000"),
    (30.0, "41f00000"),
    (-40.0, "c2200000"),
    (50.0, "42480000"),
    (-60.0, "c2700000"),
    (70.0, "428c0000"),
    (-80.0, "c2a00000"),
    (90.0, "42b40000"),
    (-100.0, "c2c80000"),
    (110.0, "42dc0000"),
    (-120.0, "c2f00000"),
    (130.0, "43020000"),
    (-140.0, "c30c0000"),
    (150.0, "43160000"),
    (-160.0, "c3200000"),
];

/// Bytes written as hexadecimal digits.
pub fn bytes(hex: &str) -> Vec<u8> {
    let hex = hex.replace(' ', "");
    (0..hex.len()).step_by(2).map(|i| u8::from_str_radix(&hex[i..i + 2], 16).unwrap()).collect()
}

/// A frame that carries, behind `before`, the values of all joints that number of times.
pub fn of_joints(header: &str, before: &str, times: usize) -> Vec<u8> {
    let joints = JOINTS.iter().take(DOF).map(|(_, float)| *float).collect::<String>().repeat(times);
    let payload = bytes(&format!("{before}{joints}"));
    let mut frame = bytes(header);
    frame.push(payload.len().try_into().unwrap());
    frame.extend(payload);
    let sum: u32 = frame.iter().map(|byte| u32::from(*byte)).sum();
    frame.extend([(sum / 256) as u8, (sum % 256) as u8]);
    frame
}
