//! Wire format of the Piper: encoding and decoding in wire units (0.001°, 0.001 mm, 0.001 rad/s, mA, mNm), without I/O.
//! All numbers are big-endian.
//!
//! There is intentionally no encoder for 0x150 (stop and reset): its stop can only be left by its reset, which disables
//! the motors, so that the arm falls.

use dimos_hardware::transport::can::CanFrame;

/// Number of joints.
pub const DOF: usize = 6;

/// One value per joint, in wire units.
pub type WireJoints = [i32; DOF];

// --- Commands ---

/// How the controller brings the arm to its targets (0x151, byte 1).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum MoveMode {
    /// Pose targets (MOVE P).
    Pose = 0,
    /// Joint targets (MOVE J).
    Joint = 1,
}

/// How closely the controller follows joint targets (0x151, byte 3).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Follow {
    /// It smooths the way to each target.
    Smooth = 0x00,
    /// It hands each target to the motors as it is.
    Direct = 0xAD,
}

/// The eight bytes of a frame.
fn frame(id: u16, data: [u8; 8]) -> CanFrame {
    CanFrame { id, len: 8, data }
}

/// Two 32-bit numbers.
fn pair(id: u16, first: i32, second: i32) -> CanFrame {
    let ([a, b, c, d], [e, f, g, h]) = (first.to_be_bytes(), second.to_be_bytes());
    frame(id, [a, b, c, d, e, f, g, h])
}

/// 0x151: control over CAN, in a move mode, at a speed [%].
fn motion_control(mode: MoveMode, speed: u8, follow: Follow) -> CanFrame {
    frame(0x151, [1, mode as u8, speed.min(100), follow as u8, 0, 0, 0, 0])
}

/// Joint targets [0.001°] at a speed [%]. 0x151 precedes every burst, so that a lost frame affects one burst only.
pub fn joint_targets(speed: u8, follow: Follow, [j1, j2, j3, j4, j5, j6]: WireJoints) -> [CanFrame; 4] {
    let mode = motion_control(MoveMode::Joint, speed, follow);
    [mode, pair(0x155, j1, j2), pair(0x156, j3, j4), pair(0x157, j5, j6)]
}

/// End-effector target: x, y, z [0.001 mm], roll, pitch, yaw [0.001°], at a speed [%].
pub fn pose_target(speed: u8, [x, y, z, roll, pitch, yaw]: [i32; 6]) -> [CanFrame; 4] {
    let mode = motion_control(MoveMode::Pose, speed, Follow::Smooth);
    [mode, pair(0x152, x, y), pair(0x153, z, roll), pair(0x154, pitch, yaw)]
}

/// Opens the gripper to a stroke [0.001 mm] with a maximum torque [mNm], and enables it.
pub fn gripper_target(stroke: i32, torque: u16) -> CanFrame {
    let ([a, b, c, d], [e, f]) = (stroke.to_be_bytes(), torque.min(5000).to_be_bytes());
    frame(0x159, [a, b, c, d, e, f, 1, 0])
}

/// Clears the gripper's errors and leaves it on or off, with a target stroke [0.001 mm] and a maximum torque [mNm].
pub fn clear_gripper(stroke: i32, torque: u16, on: bool) -> CanFrame {
    let [a, b, c, d, e, f, ..] = gripper_target(stroke, torque).data;
    frame(0x159, [a, b, c, d, e, f, if on { 3 } else { 2 }, 0])
}

/// Enables or disables all motors, the gripper's too.
pub fn enable(on: bool) -> CanFrame {
    frame(0x471, [7, if on { 2 } else { 1 }, 0, 0, 0, 0, 0, 0])
}

/// Clears the errors of all joints and changes nothing else: no zero point is set, accelerations are kept.
pub fn clear_errors() -> CanFrame {
    frame(0x475, [7, 0, 0, 0x7F, 0xFF, 0xAE, 0, 0])
}

/// Requests the position and speed limits of a joint, from 1.
pub fn ask_limits(joint: u8) -> CanFrame {
    frame(0x472, [joint, 1, 0, 0, 0, 0, 0, 0])
}

/// Requests the firmware's name.
pub fn ask_firmware() -> CanFrame {
    frame(0x4AF, [1, 0, 0, 0, 0, 0, 0, 0])
}

// --- Feedback ---

/// Status of the controller (0x2A1).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Status {
    /// Who controls the arm: 0 none, 1 CAN, 2 teaching …
    pub control: u8,
    /// State of the arm; 0 = normal.
    pub arm: u8,
    /// Move mode: 0 MOVE P, 1 MOVE J …
    pub mode: u8,
    /// State of teaching; 0 = off.
    pub teaching: u8,
    /// Joints beyond their limits: bit 0 = joint 1.
    pub limits: u8,
    /// Joints that do not answer: bit 0 = joint 1.
    pub silent: u8,
}

/// A motor, fast part (0x251–6).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Motor {
    /// [0.001 rad/s]
    pub speed: i16,
    /// [mA]
    pub current: i16,
}

/// A motor's driver, slow part (0x261–6).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Driver {
    /// Supply [0.1 V].
    pub voltage: u16,
    /// Of the driver [°C].
    pub driver_temperature: i16,
    /// Of the motor [°C].
    pub motor_temperature: i8,
    /// Bits: 0 low voltage, 1 motor hot, 2 overcurrent, 3 driver hot, 4 collision, 5 driver error, 6 enabled, 7 stall.
    pub status: u8,
}

impl Driver {
    /// Whether the motor is on.
    pub fn enabled(&self) -> bool {
        self.status & 0x40 != 0
    }
}

/// The gripper (0x2A8).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Gripper {
    /// Opening [0.001 mm].
    pub stroke: i32,
    /// Torque of its motor [mNm].
    pub torque: i16,
    /// Bits: 0 low voltage, 1 motor hot, 2 overcurrent, 3 driver hot, 4 sensor, 5 driver error, 6 enabled, 7 homed.
    pub status: u8,
}

impl Gripper {
    /// Whether its motor is on.
    pub fn enabled(&self) -> bool {
        self.status & 0x40 != 0
    }
}

/// A joint's limits as the controller has them (0x473).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct MotorLimits {
    /// [0.1°]
    pub upper: i16,
    /// [0.1°]
    pub lower: i16,
    /// [0.001 rad/s]
    pub speed: u16,
}

/// A decoded frame. Indices of joints and parts count from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FeedbackFrame {
    /// 0x2A1
    Status(Status),
    /// 0x2A2–4, a third of the pose: x y, z roll, pitch yaw [0.001 mm, 0.001°].
    Pose(usize, [i32; 2]),
    /// 0x2A5–7, a third of the joint positions [0.001°].
    Joints(usize, [i32; 2]),
    /// 0x2A8
    Gripper(Gripper),
    /// 0x251–6
    Motor(usize, Motor),
    /// 0x261–6
    Driver(usize, Driver),
    /// 0x473
    Limits(usize, MotorLimits),
    /// 0x4AF: a piece of text and its length.
    Firmware([u8; 8], usize),
    /// A frame of a leader arm: its own joints as commands, or feedback with shifted identifiers.
    Leader,
    /// Another command to the arm: a stop, a mode, a pose, its motors, its errors.
    Command,
    /// A frame with too few bytes, or with impossible values.
    Damaged,
    /// Not used.
    Other,
}

/// Decodes a frame. Never fails: see [`FeedbackFrame::Damaged`] and [`FeedbackFrame::Other`].
pub fn decode(frame: &CanFrame) -> FeedbackFrame {
    let id = frame.id;
    if let 0x151 | 0x155..=0x157 | 0x159 | 0x3A0..=0x3AF = id {
        return FeedbackFrame::Leader;
    }
    if let 0x150 | 0x152..=0x154 | 0x158 | 0x15A..=0x15F | 0x470 | 0x471 | 0x474 | 0x475 = id {
        return FeedbackFrame::Command;
    }
    if id == 0x4AF {
        return FeedbackFrame::Firmware(frame.data, usize::from(frame.len.min(8)));
    }
    let [a, b, c, d, e, f, g, h] = frame.data;
    let two = [i32::from_be_bytes([a, b, c, d]), i32::from_be_bytes([e, f, g, h])];
    let from = |first: u16| usize::from(id.wrapping_sub(first));
    let feedback = match id {
        0x2A1 => FeedbackFrame::Status(Status {
            control: a,
            arm: b,
            mode: c,
            teaching: d,
            limits: g & 0x3F,
            silent: h & 0x3F,
        }),
        0x2A2..=0x2A4 => FeedbackFrame::Pose(from(0x2A2), two),
        0x2A5..=0x2A7 => FeedbackFrame::Joints(from(0x2A5), two),
        0x2A8 => FeedbackFrame::Gripper(Gripper { stroke: two[0], torque: i16::from_be_bytes([e, f]), status: g }),
        0x251..=0x256 => {
            let motor = Motor { speed: i16::from_be_bytes([a, b]), current: i16::from_be_bytes([c, d]) };
            FeedbackFrame::Motor(from(0x251), motor)
        }
        0x261..=0x266 => {
            let driver = Driver {
                voltage: u16::from_be_bytes([a, b]),
                driver_temperature: i16::from_be_bytes([c, d]),
                motor_temperature: i8::from_be_bytes([e]),
                status: f,
            };
            FeedbackFrame::Driver(from(0x261), driver)
        }
        0x473 if (1..=6).contains(&a) => {
            let limits = MotorLimits {
                upper: i16::from_be_bytes([b, c]),
                lower: i16::from_be_bytes([d, e]),
                speed: u16::from_be_bytes([f, g]),
            };
            FeedbackFrame::Limits(usize::from(a) - 1, limits)
        }
        0x473 => FeedbackFrame::Damaged,
        _ => return FeedbackFrame::Other,
    };
    if frame.len == 8 { feedback } else { FeedbackFrame::Damaged }
}

// --- Angles ---

/// [rad] from [0.001°].
pub fn radians(wire: i32) -> f64 {
    (f64::from(wire) / 1000.0).to_radians()
}

/// [0.001°] from [rad].
pub fn millidegrees(value: f64) -> i32 {
    (value.to_degrees() * 1000.0).round() as i32
}

// --- Texts ---

/// Returns the text of a state of the arm (0x2A1, byte 1).
pub fn arm_text(code: u8) -> &'static str {
    match code {
        0 => "in order",
        1 => "E-stop",
        2 => "no solution for the target",
        3 => "singular pose",
        4 => "target beyond the joint limits",
        5 => "a joint does not answer the controller",
        6 => "a joint's brake is not released",
        7 => "collision",
        8 => "too fast while being taught",
        9 => "a joint is in error",
        10 => "an error that the arm does not name",
        11 => "recording a taught motion",
        12 => "playing a taught motion",
        13 => "pausing in a taught motion",
        14 => "the controller is too hot",
        15 => "the release resistor is too hot",
        _ => "a state that the sheet does not list",
    }
}

/// Returns who controls the arm (0x2A1, byte 0).
pub fn control_text(control: u8) -> &'static str {
    match control {
        0 => "no client",
        1 => "CAN",
        2 => "its teach button",
        3 => "Ethernet",
        4 => "Wi-Fi",
        5 => "a remote control",
        6 => "a leader arm",
        7 => "a program of its own",
        _ => "something that the sheet does not list",
    }
}

/// Returns the name of a move mode (0x2A1, byte 2).
pub fn mode_text(mode: u8) -> &'static str {
    match mode {
        0 => "MOVE P",
        1 => "MOVE J",
        2 => "MOVE L",
        3 => "MOVE C",
        4 => "MIT",
        5 => "CPV",
        _ => "a mode that the sheet does not list",
    }
}

/// Returns the text of a driver's error bit (0x261–6, byte 5); `None` for bits that are not errors.
pub fn driver_text(bit: u8) -> Option<&'static str> {
    match bit {
        0 => Some("low voltage"),
        1 => Some("motor too hot"),
        2 => Some("overcurrent"),
        3 => Some("driver too hot"),
        4 => Some("collision"),
        5 => Some("driver error"),
        7 => Some("stalled"),
        _ => None,
    }
}

/// Returns the text of a gripper's error bit (0x2A8, byte 6); `None` for bits that are not errors.
pub fn gripper_text(bit: u8) -> Option<&'static str> {
    match bit {
        4 => Some("sensor error"),
        0..=3 | 5 => driver_text(bit),
        _ => None,
    }
}

#[cfg(test)]
#[path = "protocol_tests.rs"]
mod tests;
