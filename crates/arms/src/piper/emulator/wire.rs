//! The frames as the controller sees them: commands in, feedback out. Written from the sheet a second time, on purpose
//! without `protocol.rs`: an emulator that shared the adapter's encoders would share its mistakes.

use dimos_hardware::transport::can::CanFrame;

/// A request of a client, in wire units. Joints count from 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Request {
    /// 0x150: stop (0 nothing, 1 E-stop, 2 reset) and drag-teaching (1 start, 2 stop).
    Halt {
        /// Byte 0.
        stop: u8,
        /// Byte 2.
        teach: u8,
    },
    /// 0x151
    Control {
        /// 0 standby, 1 CAN.
        control: u8,
        /// 0 P, 1 J, 2 L, 3 C, 4 MIT, 5 CPV.
        mode: u8,
        /// [%]
        speed: u8,
        /// 0 smooth, 0xAD direct.
        follow: u8,
    },
    /// 0x152–4: part 0–2 of a pose [0.001 mm, 0.001°].
    Pose(usize, [i32; 2]),
    /// 0x155–7: part 0–2 of joint targets [0.001°].
    Joints(usize, [i32; 2]),
    /// 0x159: stroke [0.001 mm], torque [mNm], and what to do (bit 0: enable, bit 1: clear errors).
    Gripper(i32, u16, u8),
    /// 0x15A–F: one joint by impedance.
    Mit(u8),
    /// 0x470: 0xFA leader, 0xFC follower.
    Role(u8),
    /// 0x471: a motor (7, 255: all), 1 off, 2 on.
    Motors(u8, u8),
    /// 0x472: a motor; 1 limits, 2 acceleration.
    Query(u8, u8),
    /// 0x474: a motor, its highest and lowest angle [0.1°] and speed [0.001 rad/s]; 0x7FFF keeps.
    SetLimits(u8, i16, i16, u16),
    /// 0x475: a motor; whether to set its zero point, and to clear its error.
    Configure(u8, bool, bool),
    /// 0x4AF
    Firmware,
}

/// Reads a frame; `None`: not for this controller.
pub fn understand(frame: &CanFrame) -> Option<Request> {
    let b = if frame.len == 8 { frame.data.map(u32::from) } else { return None };
    let [b0, b1, b2, b3, b4, b5, b6, _] = frame.data;
    let number = |i: usize| b.get(i..i + 4).map_or(0, |w| w.iter().fold(0, |sum, byte| sum << 8 | byte)) as i32;
    let short = |high: u8, low: u8| u16::from(high) * 256 + u16::from(low);
    let two = [number(0), number(4)];
    Some(match frame.id {
        0x150 => Request::Halt { stop: b0, teach: b2 },
        0x151 => Request::Control { control: b0, mode: b1, speed: b2, follow: b3 },
        0x152 => Request::Pose(0, two),
        0x153 => Request::Pose(1, two),
        0x154 => Request::Pose(2, two),
        0x155 => Request::Joints(0, two),
        0x156 => Request::Joints(1, two),
        0x157 => Request::Joints(2, two),
        0x159 => Request::Gripper(number(0), short(b4, b5), b6),
        0x15A..=0x15F => Request::Mit((frame.id - 0x159) as u8),
        0x470 => Request::Role(b0),
        0x471 => Request::Motors(b0, b1),
        0x472 => Request::Query(b0, b1),
        0x474 => Request::SetLimits(b0, short(b1, b2) as i16, short(b3, b4) as i16, short(b5, b6)),
        0x475 => Request::Configure(b0, b1 == 0xAE, b5 == 0xAE),
        0x4AF => Request::Firmware,
        _ => return None,
    })
}

/// A frame of whole numbers, each with its width in bytes.
fn make(id: u16, numbers: &[(i64, usize)]) -> CanFrame {
    let mut frame = CanFrame { id, len: 8, data: [0; 8] };
    let bytes = numbers.iter().flat_map(|(value, width)| (0..*width).rev().map(move |i| (value >> (8 * i)) as u8));
    frame.data.iter_mut().zip(bytes).for_each(|(to, byte)| *to = byte);
    frame
}

/// 0x2A1
#[derive(Debug, Clone, Copy, Default)]
pub struct Status {
    /// Who controls.
    pub control: u8,
    /// State of the arm.
    pub arm: u8,
    /// Move mode.
    pub mode: u8,
    /// Being taught.
    pub teach: u8,
    /// On the way.
    pub moving: bool,
    /// Joints beyond their limits.
    pub limits: u8,
}

impl Status {
    /// The frame.
    pub fn frame(self) -> CanFrame {
        let Self { control, arm, mode, teach, moving, limits } = self;
        make(0x2A1, &[control, arm, mode, teach, u8::from(moving), 0, limits, 0].map(|byte| (i64::from(byte), 1)))
    }
}

/// Three frames of two numbers each, from identifier `first` on.
pub fn triple(first: u16, values: [i32; 6]) -> [CanFrame; 3] {
    let [a, b, c, d, e, f] = values.map(|value| (i64::from(value), 4));
    [make(first, &[a, b]), make(first + 1, &[c, d]), make(first + 2, &[e, f])]
}

/// 0x2A8: stroke [0.001 mm], torque [mNm], status.
pub fn gripper(stroke: i32, torque: i16, status: u8) -> CanFrame {
    make(0x2A8, &[(stroke.into(), 4), (torque.into(), 2), (status.into(), 1)])
}

/// 0x251–6: speed [0.001 rad/s], current [mA], position [0.001 rad]. Joints count from 1.
pub fn motor(joint: u16, speed: i32, current: i32, position: i32) -> CanFrame {
    make(0x250 + joint, &[(speed.into(), 2), (current.into(), 2), (position.into(), 4)])
}

/// 0x261–6: supply [0.1 V], driver and motor [°C], status, supply current [mA].
pub fn driver(joint: u16, voltage: i32, temperatures: [i8; 2], status: u8, current: i32) -> CanFrame {
    let [driver, motor] = temperatures.map(i64::from);
    make(0x260 + joint, &[(voltage.into(), 2), (driver, 2), (motor, 1), (status.into(), 1), (current.into(), 2)])
}

/// 0x473: highest and lowest angle [0.1°], speed [0.001 rad/s].
pub fn limits(joint: u8, upper: i16, lower: i16, speed: u16) -> CanFrame {
    make(0x473, &[(joint.into(), 1), (upper.into(), 2), (lower.into(), 2), (speed.into(), 2)])
}

/// 0x47C: acceleration [0.001 rad/s²].
pub fn acceleration(joint: u8, acceleration: u16) -> CanFrame {
    make(0x47C, &[(joint.into(), 1), (acceleration.into(), 2)])
}

/// 0x476: the command with this low byte of its identifier was heard. A zero point is never set.
pub fn acknowledge(id: u16) -> CanFrame {
    make(0x476, &[(i64::from(id & 0xFF), 1)])
}

/// 0x4AF: eight characters.
pub fn firmware(text: &[u8; 8]) -> CanFrame {
    make(0x4AF, &text.map(|byte| (byte.into(), 1)))
}

/// What a leader arm sends: its pose as commands for others.
pub fn leading(joints: [i32; 6], stroke: i32) -> [CanFrame; 5] {
    let [a, b, c] = triple(0x155, joints);
    let control = make(0x151, &[(1, 1), (1, 1), (100, 1)]);
    [control, a, b, c, make(0x159, &[(stroke.into(), 4), (1000, 2), (1, 1)])]
}

#[cfg(test)]
mod tests {
    use super::super::super::golden::{self, JOINTS, POSE, frame};
    use super::*;

    #[test]
    fn commands_are_read_from_the_golden_bytes() {
        let read = |text| understand(&frame(text));
        let control = |mode, speed, follow| Some(Request::Control { control: 1, mode, speed, follow });
        assert_eq!(read(golden::MOVE_JOINTS[0]), control(1, 25, 0));
        assert_eq!(read(golden::MOVE_DIRECT), control(1, 100, 0xAD));
        assert_eq!(read(golden::MOVE_POSE[0]), control(0, 50, 0));
        for part in 0..3 {
            let two = |all: [i32; 6]| [all[2 * part], all[2 * part + 1]];
            assert_eq!(read(golden::MOVE_JOINTS[part + 1]), Some(Request::Joints(part, two(JOINTS))));
            assert_eq!(read(golden::MOVE_POSE[part + 1]), Some(Request::Pose(part, two(POSE))));
        }
        assert_eq!(read(golden::GRIPPER), Some(Request::Gripper(42_500, 1000, 1)));
        assert_eq!(read(golden::CLEAR_GRIPPER[0]), Some(Request::Gripper(42_500, 1000, 3)));
        assert_eq!(read(golden::CLEAR_GRIPPER[1]), Some(Request::Gripper(0, 1000, 2)));
        assert_eq!(read(golden::ENABLE), Some(Request::Motors(7, 2)));
        assert_eq!(read(golden::DISABLE), Some(Request::Motors(7, 1)));
        assert_eq!(read(golden::CLEAR), Some(Request::Configure(7, false, true)));
        assert_eq!(read(golden::ASK_LIMITS), Some(Request::Query(2, 1)));
        assert_eq!(read(golden::ASK_FIRMWARE), Some(Request::Firmware));
        assert_eq!(read("150#0200000000000000"), Some(Request::Halt { stop: 2, teach: 0 }));
        assert_eq!(read("15A#0000000000000000"), Some(Request::Mit(1)));
        assert_eq!(read("470#FC00000000000000"), Some(Request::Role(0xFC)));
        assert_eq!(read("474#017FFFFC7C0BB800"), Some(Request::SetLimits(1, 0x7FFF, -900, 3000)));
        for none in ["150#02", "2A5#0000000000000000", "422#0000000000000000"] {
            assert_eq!(read(none), None);
        }
    }

    #[test]
    fn feedback_is_the_golden_bytes() {
        let status = Status { control: 1, arm: 4, mode: 1, teach: 0, moving: true, limits: 2 };
        let mut golden_status = frame(golden::STATUS);
        golden_status.data[7] = 0; // no joint of the emulator ever falls silent
        assert_eq!(status.frame(), golden_status);
        assert_eq!(triple(0x2A2, POSE), golden::POSE_FEEDBACK.map(frame));
        assert_eq!(triple(0x2A5, JOINTS), golden::JOINT_FEEDBACK.map(frame));
        assert_eq!(gripper(42_500, -500, 0xC0), frame(golden::GRIPPER_FEEDBACK));
        assert_eq!(motor(1, -1500, 2000, 999), frame(golden::MOTOR_1));
        assert_eq!(motor(6, 1, -1, -1000), frame(golden::MOTOR_6));
        assert_eq!(driver(3, 240, [45, -5], 0xC0, 1500), frame(golden::DRIVER_3));
        assert_eq!(limits(3, 0, -1700, 3000), frame(golden::LIMITS_3));
        assert_eq!(acceleration(3, 5000), frame(golden::ACCELERATION_3));
        assert_eq!(acknowledge(0x471), frame(golden::ACK_ENABLE));
        assert_eq!(firmware(b"S-V1.6-3"), frame(golden::FIRMWARE));
        assert_eq!(
            leading(JOINTS, 42_500)[1..4],
            golden::MOVE_JOINTS[1..].iter().map(|t| frame(t)).collect::<Vec<_>>()
        );
    }
}
