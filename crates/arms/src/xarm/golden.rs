//! Frames and parts of reports computed from the vendor's documents with independent tools (Python's `struct`); the
//! setpoint is the one that the vendor's client sends. Adapter and emulator are both tested against them, so that a
//! mistake in both shows.

/// Parses hexadecimal digits.
pub fn bytes(hex: &str) -> Vec<u8> {
    (0..hex.len()).step_by(2).map(|i| u8::from_str_radix(&hex[i..i + 2], 16).unwrap()).collect()
}

/// Returns a packet of zeros with these parts: offset and digits.
pub fn packet(length: usize, parts: &[(usize, &str)]) -> Vec<u8> {
    let mut packet = vec![0; length];
    for (at, hex) in parts {
        let part = bytes(hex);
        packet[*at..at + part.len()].copy_from_slice(&part);
    }
    packet
}

/// Joints of the samples [deg], and their bytes in radians.
pub const DEGREES: [f64; 7] = [10.0, -20.0, -30.0, 40.0, 50.0, -60.0, 0.0];
const Q: &str = "c2b8323ec2b8b2be920a06bfc2b8323ff3665f3f920a86bf00000000";
/// Velocities of the samples [rad/s].
pub const VELOCITIES: [f64; 7] = [1.0, -2.0, 3.0, -0.5, 0.25, 0.0, 0.0];
const QD: &str = "0000803f000000c000004040000000bf0000803e0000000000000000";
/// Torques of the samples [Nm].
pub const TORQUES: [f64; 7] = [0.5, -0.5, 1.0, -1.0, 2.0, -2.0, 0.0];
const TAU: &str = "0000003f000000bf0000803f000080bf00000040000000c000000000";
/// Pose of the samples [mm, rad].
pub const POSE: [f64; 6] = [300.0, -100.0, 250.5, 3.0, 0.25, -1.5];
const POSE_HEX: &str = "000096430000c8c200807a43000040400000803e0000c0bf";
/// Force and torque of the samples [N, Nm].
pub const WRENCH: [f64; 6] = [1.0, 2.0, 3.0, 0.5, 0.25, 0.125];
const WRENCH_HEX: &str = "0000803f00000040000040400000003f0000803e0000003e";

/// Version, transaction 1, protocol 2.
pub const VERSION: &str = "00010002000101";
/// All motors on, transaction 2, protocol 3 from here on.
pub const ENABLE: &str = "0002000300030b0801";
/// Mode 1, with collision detection.
pub const SET_MODE: &str = "000300030003130100";
/// Mode 1 for firmware that has no such parameter, protocol 2.
pub const SET_MODE_OLD: &str = "0003000200021301";
/// State 0.
pub const READY: &str = "0004000300020c00";
/// A setpoint.
pub const SERVO: &str =
    "0005000300291dc2b8323ec2b8b2be920a06bfc2b8323ff3665f3f920a86bf00000000000000000000000000000000";
/// A planned move at 0.5 rad/s, 8 rad/s².
pub const MOVE_JOINTS: &str =
    "00060003002917c2b8323ec2b8b2be920a06bfc2b8323ff3665f3f920a86bf000000000000003f0000004100000000";
/// A line to [`POSE`] at 100 mm/s, 2000 mm/s².
pub const MOVE_LINE: &str = "00070003002515000096430000c8c200807a43000040400000803e0000c0bf0000c8420000fa4400000000";
/// 1.5 and −0.5 rad/s at joints 1 and 6, for 0.2 s.
pub const VELOCITY: &str = "000800030022510000c03f00000000000000000000000000000000000000bf0000000001cdcc4c3e";
/// The gripper to 850 pulses.
pub const GRIPPER_GO: &str = "00090003000d7c090810070000020400000352";
/// Where is the gripper?
pub const GRIPPER_READ: &str = "000a000300087c09080307020002";
/// The baud rate of the tool.
pub const TOOL_BAUD: &str = "000b0003000480090a0b";
/// A load of 1.5 kg at 0, −10, 80 mm.
pub const SET_LOAD: &str = "000c00030011240000c03f00000000000020c10000a042";
/// Error and warning, the last transaction before 1.
pub const GET_ERROR: &str = "ffff000300010f";
/// The telegram that sends a G2 to 0 pulses at 100 mm/s with half its force.
pub const GRIPPER_G2: &str = "08100c0000050a0001074c003200000000";

/// Answer to [`VERSION`] of a disabled xArm 6.
pub const VERSION_REPLY: &str =
    "00010002002a0110362c362c5849313330352c4143313330352c76322e352e3100000000000000000000000000000000";
/// Answer to [`SERVO`].
pub const SERVO_REPLY: &str = "0005000300021d00";
/// Answer to [`MOVE_JOINTS`]: one command in the queue.
pub const MOVE_REPLY: &str = "00060003000417000001";
/// Answer to [`GRIPPER_READ`]: 425 pulses.
pub const GRIPPER_READ_REPLY: &str = "000a0003000a7c0009080304000001a9";
/// Answer to [`GET_ERROR`]: error 31, not ready.
pub const ERROR_REPLY: &str = "ffff000300040f501f00";

/// A report of port 30000 at 123.456789 s: moving, mode 1, 3 commands in the queue.
pub fn full() -> Vec<u8> {
    full_of(804, "00000324")
}

/// The same from an older firmware, which sends 784 bytes.
pub fn full_784() -> Vec<u8> {
    full_of(784, "00000310")
}

fn full_of(length: usize, head: &str) -> Vec<u8> {
    let head = [(0, head), (4, "00000000075bcd15"), (12, "11"), (13, "0003")];
    let target = [(32, Q), (60, QD), (116, Q), (144, QD), (228, TAU)];
    packet(length, &[&head[..], &target, &[(424, POSE_HEX), (472, POSE_HEX), (712, WRENCH_HEX)]].concat())
}

/// The same at port 30003, in mode 4.
pub fn real() -> Vec<u8> {
    let parts = [(0, "00000087"), (4, "41"), (5, "0003"), (7, Q), (35, POSE_HEX), (59, TAU), (87, WRENCH_HEX)];
    packet(135, &parts)
}

/// The same at port 30001: motors of six joints on, error 31, warning 11, sensitivities 3 and 4.
pub fn normal() -> Vec<u8> {
    let parts = [(0, "00000091"), (4, "14"), (7, Q), (35, POSE_HEX), (59, TAU)];
    packet(145, &[&parts[..], &[(87, "3f3f1f0b"), (131, "0304"), (141, "000080bf")]].concat())
}
