//! Frames written down by hand from the sheet. Adapter and emulator are both tested against them, so that a mistake
//! which both sides share still shows.
//!
//! YOUR ARM: take them from the manual's examples, or record the bus (`candump`) while the vendor's own program runs.

use super::DOF;
use dimos_hardware::transport::can::CanFrame;

/// Motors on.
pub const ENABLE: &str = "150 01 01 00 00 00 00 00 00";
/// Setpoints, speed 25 %.
pub const MODE: &str = "150 02 01 19 00 00 00 00 00";
/// Clear the error.
pub const CLEAR: &str = "150 03 00 00 00 00 00 00 00";
/// Stop.
pub const STOP: &str = "150 04 00 00 00 00 00 00 00";
/// Who are you?
pub const IDENTIFY: &str = "150 05 00 00 00 00 00 00 00";

/// Motors on, moving, setpoints, error 2.
pub const STATUS: &str = "2c0 03 01 00 02 00 00 00 00";
/// Model 1, 6 joints, firmware 2.1, serial number 42.
pub const IDENTITY: &str = "2d0 01 06 02 01 00 00 00 2a";

/// Values of the joints [0.001 deg], and the same on the wire.
pub const JOINTS: [(i32, &str); 16] = [
    (10_000, "00 00 27 10"),
    (-20_000, "ff ff b1 e0"),
    (30_000, "00 00 75 30"),
    (-40_000, "ff ff 63 c0"),
    (50_000, "00 00 c3 50"),
    (-60_000, "ff ff 15 a0"),
    (70_000, "00 01 11 70"),
    (-80_000, "ff fe c7 80"),
    (90_000, "00 01 5f 90"),
    (-100_000, "ff fe 79 60"),
    (110_000, "00 01 ad b0"),
    (-120_000, "ff fe 2b 40"),
    (130_000, "00 01 fb d0"),
    (-140_000, "ff fd dd 20"),
    (150_000, "00 02 49 f0"),
    (-160_000, "ff fd 8f 00"),
];

/// A frame as `candump` writes it: identifier, then the data bytes, all hexadecimal.
pub fn frame(text: &str) -> CanFrame {
    let mut numbers = text.split_whitespace().map(|word| u16::from_str_radix(word, 16).unwrap());
    let id = numbers.next().unwrap();
    let data: Vec<u8> = numbers.map(|byte| byte.try_into().unwrap()).collect();
    CanFrame::new(id, &data)
}

/// The frames from identifier `id` on that hold the values of all joints, two in each.
pub fn of_joints(id: u16) -> Vec<CanFrame> {
    let joints: Vec<&str> = JOINTS.iter().take(DOF).map(|(_, bytes)| *bytes).collect();
    let pairs = joints.chunks(2).zip(id..);
    pairs.map(|(pair, id)| frame(&format!("{id:x} {} {}", pair[0], pair.get(1).unwrap_or(&"00 00 00 00")))).collect()
}
