//! Frames written by hand from the data sheet: `id#data`. The code of both adapter and emulator is compared with them.

use dimos_hardware::transport::can::CanFrame;

/// A frame from its text.
pub fn frame(text: &str) -> CanFrame {
    let (id, data) = text.split_once('#').unwrap();
    let bytes: Vec<u8> =
        (0..data.len() / 2).map(|i| u8::from_str_radix(&data[2 * i..2 * i + 2], 16).unwrap()).collect();
    CanFrame::new(u16::from_str_radix(id, 16).unwrap(), &bytes)
}

/// 1.5°, −90°, 0.001°, −0.001°, 65.536°, −65.536° [0.001°].
pub const JOINTS: [i32; 6] = [1_500, -90_000, 1, -1, 65_536, -65_536];
/// 56.128 mm, −200 mm, 213.266 mm, −180°, 85°, 0.5°.
pub const POSE: [i32; 6] = [56_128, -200_000, 213_266, -180_000, 85_000, 500];

/// MOVE J at 25 %, smoothed, to [`JOINTS`].
pub const MOVE_JOINTS: [&str; 4] =
    ["151#0101190000000000", "155#000005DCFFFEA070", "156#00000001FFFFFFFF", "157#00010000FFFF0000"];
/// MOVE J at 100 %, direct.
pub const MOVE_DIRECT: &str = "151#010164AD00000000";
/// MOVE P at 50 % to [`POSE`].
pub const MOVE_POSE: [&str; 4] =
    ["151#0100320000000000", "152#0000DB40FFFCF2C0", "153#00034112FFFD40E0", "154#00014C08000001F4"];
/// Gripper to 42.5 mm with 1 Nm, enabled.
pub const GRIPPER: &str = "159#0000A60403E80100";
/// The same, which clears its errors; and to 0, off.
pub const CLEAR_GRIPPER: [&str; 2] = ["159#0000A60403E80300", "159#0000000003E80200"];
/// All motors on, and off.
pub const ENABLE: &str = "471#0702000000000000";
pub const DISABLE: &str = "471#0701000000000000";
/// Errors of all joints cleared.
pub const CLEAR: &str = "475#0700007FFFAE0000";
/// The limits of joint 2, please; and the firmware.
pub const ASK_LIMITS: &str = "472#0201000000000000";
pub const ASK_FIRMWARE: &str = "4AF#0100000000000000";

/// CAN control, target beyond limits, MOVE J, on its way; joint 2 beyond its limits, joint 6 silent.
pub const STATUS: &str = "2A1#0104010001000220";
/// [`POSE`] and [`JOINTS`] as feedback.
pub const POSE_FEEDBACK: [&str; 3] = ["2A2#0000DB40FFFCF2C0", "2A3#00034112FFFD40E0", "2A4#00014C08000001F4"];
pub const JOINT_FEEDBACK: [&str; 3] = ["2A5#000005DCFFFEA070", "2A6#00000001FFFFFFFF", "2A7#00010000FFFF0000"];
/// 42.5 mm, −0.5 Nm, enabled and homed.
pub const GRIPPER_FEEDBACK: &str = "2A8#0000A604FE0CC000";
/// Joint 1: −1.5 rad/s, 2 A, 0.001 rad short of one radian (999); joint 6: 0.001 rad/s, −0.001 A, −1000.
pub const MOTOR_1: &str = "251#FA2407D0000003E7";
pub const MOTOR_6: &str = "256#0001FFFFFFFFFC18";
/// Joint 3: 24 V, driver 45 °C, motor −5 °C, enabled and stalled, 1.5 A.
pub const DRIVER_3: &str = "263#00F0002DFBC005DC";
/// Joint 3: 0° to −170°, 3 rad/s.
pub const LIMITS_3: &str = "473#030000F95C0BB800";
/// Joint 3: 5 rad/s² [0.001 rad/s²].
pub const ACCELERATION_3: &str = "47C#0313880000000000";
/// 0x471 was heard.
pub const ACK_ENABLE: &str = "476#7100000000000000";
/// `S-V1.6-3`.
pub const FIRMWARE: &str = "4AF#532D56312E362D33";
