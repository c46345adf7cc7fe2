//! The wire format as the controller sees it: requests in, replies out. Written from the sheet a second time, on
//! purpose without `protocol.rs`: an emulator that shared the adapter's encoders would share its mistakes.

use dimos_hardware::transport::tcp::Scan;

/// Status bytes of replies, as on the sheet.
pub mod status {
    #![expect(missing_docs, reason = "the names of the protocol sheet")]
    pub const OK: u8 = 0;
    pub const UNKNOWN_COMMAND: u8 = 1;
    pub const MALFORMED: u8 = 2;
    pub const BUSY: u8 = 3;
    pub const DISABLED: u8 = 4;
    pub const WRONG_MODE: u8 = 5;
    pub const MOVING: u8 = 6;
    pub const OUT_OF_RANGE: u8 = 7;
    pub const IN_ERROR: u8 = 8;
    pub const NO_CHANNEL: u8 = 10;
}

/// What a client asked, in wire units (deg, deg/s, mm, %).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Request {
    /// 0x01
    Hello,
    /// 0x02; with 1 as payload also the gripper's force.
    GetState(bool),
    /// 0x03: 0 position, 1 servo, 2 velocity.
    SetMode(u8),
    /// 0x04
    Enable(bool),
    /// 0x05
    ClearError,
    /// 0x06
    Stop,
    /// 0x10: speed [%], target [deg].
    MoveJoints(f32, [f32; 6]),
    /// 0x11: setpoint [deg].
    ServoJoints([f32; 6]),
    /// 0x12: velocities [deg/s].
    VelocityJoints([f32; 6]),
    /// 0x13: speed [%], target [mm, deg].
    MoveCartesian(f32, [f32; 6]),
    /// 0x14
    Setpoint(SetpointRequest),
    /// 0x20: opening [mm].
    Gripper(f32),
    /// 0x25: opening [mm], largest force [N].
    Grip(f32, f32),
    /// 0x21: mass [kg], centre [mm], inertia [kg·m²].
    SetPayload([f32; 10]),
    /// 0x22
    GetPayload,
    /// 0x23: direction of gravity.
    SetMounting([f32; 3]),
    /// 0x24
    GetMounting,
    /// 0x40
    GetJointStatus,
    /// 0x41
    GetOffsets,
    /// 0x30
    GetIo,
    /// 0x31: digital output, level.
    SetDigital(u8, bool),
    /// 0x32: analogue output, voltage [V].
    SetAnalog(u8, f32),
}

/// A setpoint with all that it has.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SetpointRequest {
    /// How long it holds [ms]; 0: until the next one.
    pub valid_ms: u16,
    /// The client's time [µs].
    pub time_us: u64,
    /// Positions [deg].
    pub joints: [f32; 6],
    /// Velocities [deg/s].
    pub velocities: [f32; 6],
    /// Accelerations [deg/s²].
    pub accelerations: Option<[f32; 6]>,
    /// Torques [Nm].
    pub torques: Option<[f32; 6]>,
    /// Stiffness [Nm/rad] and damping [Nm·s/rad].
    pub gains: Option<[[f32; 6]; 2]>,
}

impl Request {
    /// The positions of a setpoint [deg], with or without more.
    pub fn setpoint(&self) -> Option<[f32; 6]> {
        match self {
            Self::ServoJoints(joints) | Self::Setpoint(SetpointRequest { joints, .. }) => Some(*joints),
            _ => None,
        }
    }

    /// Whether it asks for motion.
    pub fn moves(&self) -> bool {
        matches!(
            self,
            Self::MoveJoints(..)
                | Self::ServoJoints(_)
                | Self::Setpoint(_)
                | Self::VelocityJoints(_)
                | Self::MoveCartesian(..)
                | Self::Gripper(_)
                | Self::Grip(..)
        )
    }
}

/// A frame with a good checksum, and what it asks or why that cannot be understood (a status byte).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// Opcode, echoed in the reply with its top bit set.
    pub opcode: u8,
    /// Sequence number, echoed in the reply.
    pub sequence: u16,
    /// What it asks.
    pub request: Result<Request, u8>,
}

/// Finds a request at the front of what has arrived.
pub fn scan(bytes: &[u8]) -> Scan<Frame> {
    match bytes {
        [] | [0x59] => return Scan::More,
        [0x59, 0x41, ..] => {}
        _ => return Scan::Skip(1),
    }
    let &[_, _, version, opcode, s0, s1, l0, l1, ref rest @ ..] = bytes else { return Scan::More };
    let length = l0 as usize + 256 * l1 as usize;
    if version != 1 || length > 256 {
        return Scan::Skip(1);
    }
    let (Some(payload), Some(&[c0, c1])) = (rest.get(..length), rest.get(length..length + 2)) else {
        return Scan::More;
    };
    let total = 10 + length;
    if checksum(bytes.iter().take(total - 2)) != c0 as u16 + 256 * c1 as u16 {
        return Scan::Skip(1);
    }
    Scan::Take(total, Frame { opcode, sequence: s0 as u16 + 256 * s1 as u16, request: understand(opcode, payload) })
}

fn understand(opcode: u8, payload: &[u8]) -> Result<Request, u8> {
    let empty = |request| if payload.is_empty() { Ok(request) } else { Err(status::MALFORMED) };
    match opcode {
        0x01 => empty(Request::Hello),
        0x02 => match *payload {
            [] => Ok(Request::GetState(false)),
            [1] => Ok(Request::GetState(true)),
            _ => Err(status::MALFORMED),
        },
        0x03 => one_byte(payload).filter(|mode| *mode <= 3).map(Request::SetMode).ok_or(status::MALFORMED),
        0x04 => one_byte(payload).filter(|on| *on <= 1).map(|on| Request::Enable(on == 1)).ok_or(status::MALFORMED),
        0x05 => empty(Request::ClearError),
        0x06 => empty(Request::Stop),
        0x10 | 0x13 => {
            let [speed, values @ ..] = floats::<7>(payload)?;
            if !(speed > 0.0 && speed <= 100.0) {
                return Err(status::MALFORMED);
            }
            Ok(if opcode == 0x10 { Request::MoveJoints(speed, values) } else { Request::MoveCartesian(speed, values) })
        }
        0x11 => floats(payload).map(Request::ServoJoints),
        0x12 => floats(payload).map(Request::VelocityJoints),
        0x14 => setpoint(payload).map(Request::Setpoint),
        0x20 => floats::<1>(payload).map(|[opening]| Request::Gripper(opening)),
        0x25 => floats::<2>(payload).map(|[opening, force]| Request::Grip(opening, force)),
        0x21 => floats(payload).map(Request::SetPayload),
        0x22 => empty(Request::GetPayload),
        0x23 => floats(payload).map(Request::SetMounting),
        0x24 => empty(Request::GetMounting),
        0x40 => empty(Request::GetJointStatus),
        0x41 => empty(Request::GetOffsets),
        0x30 => empty(Request::GetIo),
        0x31 => match *payload {
            [output, level @ 0..=1] => Ok(Request::SetDigital(output, level == 1)),
            _ => Err(status::MALFORMED),
        },
        0x32 => {
            let (output, volts) = payload.split_first().ok_or(status::MALFORMED)?;
            floats::<1>(volts).map(|[volts]| Request::SetAnalog(*output, volts))
        }
        _ => Err(status::UNKNOWN_COMMAND),
    }
}

/// Flags, how long, when, and then list after list.
fn setpoint(payload: &[u8]) -> Result<SetpointRequest, u8> {
    let (&[flags, v0, v1, t0, t1, t2, t3, t4, t5, t6, t7], mut rest) =
        payload.split_first_chunk::<11>().ok_or(status::MALFORMED)?;
    if flags > 7 {
        return Err(status::MALFORMED);
    }
    let mut list = || -> Result<[f32; 6], u8> {
        let (bytes, others) = rest.split_at_checked(24).ok_or(status::MALFORMED)?;
        rest = others;
        floats(bytes)
    };
    let (joints, velocities) = (list()?, list()?);
    let accelerations = if flags & 1 == 1 { Some(list()?) } else { None };
    let torques = if flags & 2 == 2 { Some(list()?) } else { None };
    let gains = if flags & 4 == 4 { Some([list()?, list()?]) } else { None };
    let time_us = [t7, t6, t5, t4, t3, t2, t1, t0].iter().fold(0, |sum, byte| sum << 8 | u64::from(*byte));
    let valid_ms = u16::from(v0) + 256 * u16::from(v1);
    let request = SetpointRequest { valid_ms, time_us, joints, velocities, accelerations, torques, gains };
    if rest.is_empty() { Ok(request) } else { Err(status::MALFORMED) }
}

fn one_byte(payload: &[u8]) -> Option<u8> {
    match payload {
        [byte] => Some(*byte),
        _ => None,
    }
}

/// Exactly N finite numbers.
fn floats<const N: usize>(payload: &[u8]) -> Result<[f32; N], u8> {
    let (chunks, rest) = payload.as_chunks::<4>();
    let mut values = [0.0; N];
    if chunks.len() != N || !rest.is_empty() {
        return Err(status::MALFORMED);
    }
    for (value, chunk) in values.iter_mut().zip(chunks) {
        *value = f32::from_bits(u32::from_le_bytes(*chunk));
        if !value.is_finite() {
            return Err(status::MALFORMED);
        }
    }
    Ok(values)
}

/// CRC-16/CCITT-FALSE, a byte at a time without a table.
fn checksum<'a>(bytes: impl Iterator<Item = &'a u8>) -> u16 {
    let mut crc = 0xFFFF_u16;
    for byte in bytes {
        crc = crc.rotate_left(8) ^ u16::from(*byte);
        crc ^= (crc & 0xFF) >> 4;
        crc ^= crc << 12;
        crc ^= (crc & 0xFF) << 5;
    }
    crc
}

/// What the controller reports as its state, in wire units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Report {
    /// Since power-up [µs].
    pub time_us: u64,
    /// 0 disabled, 1 standing, 2 moving, 3 in error.
    pub state: u8,
    /// 0 position, 1 servo, 2 velocity.
    pub mode: u8,
    /// Motors on.
    pub enabled: bool,
    /// E-stop line open.
    pub estop: bool,
    /// Error code.
    pub error: u16,
    /// [deg], [deg/s], [Nm].
    pub joints: [[f32; 6]; 3],
    /// [mm]
    pub gripper: f32,
    /// [mm, deg]
    pub pose: [f32; 6],
    /// Force of the gripper [N].
    pub force: f32,
}

/// Writes a reply into `out`, which keeps its room: header, status, what `data` adds, checksum.
pub fn reply(out: &mut Vec<u8>, frame: &Frame, status: u8, data: impl FnOnce(&mut Vec<u8>)) {
    out.clear();
    out.extend([0x59, 0x41, 1, frame.opcode | 0x80]);
    out.extend(frame.sequence.to_le_bytes());
    out.extend([0, 0, status]);
    data(out);
    let length = out.len() - 8;
    if let Some(at) = out.get_mut(6..8) {
        at.copy_from_slice(&[(length % 256) as u8, (length / 256) as u8]);
    }
    let crc = checksum(out.iter());
    out.extend([(crc & 0xFF) as u8, (crc >> 8) as u8]);
}

/// Adds the data of a HELLO reply.
pub fn put_hello(out: &mut Vec<u8>, model: &str, dof: u8, firmware: [u8; 3], serial: &str) {
    let text = |out: &mut Vec<u8>, text: &str| out.extend(text.bytes().chain(std::iter::repeat(0)).take(16));
    text(out, model);
    out.push(dof);
    out.extend(firmware);
    text(out, serial);
}

/// Adds the data of a GET_STATE reply, with the gripper's force if the client asked for it.
pub fn put_report(out: &mut Vec<u8>, report: &Report, with_force: bool) {
    out.extend(report.time_us.to_le_bytes());
    let flags = u8::from(report.enabled) + 2 + 4 * u8::from(report.estop);
    out.extend([report.state, report.mode, flags, 6]);
    out.extend(report.error.to_le_bytes());
    let numbers = report.joints.as_flattened().iter().chain([&report.gripper]).chain(&report.pose);
    let force = [&report.force].into_iter().filter(|_| with_force);
    for number in numbers.chain(force) {
        out.extend(number.to_bits().to_le_bytes());
    }
}

/// Adds the data of a reply that consists of numbers.
pub fn put_floats(out: &mut Vec<u8>, values: &[f32]) {
    out.extend(values.iter().flat_map(|v| v.to_bits().to_le_bytes()));
}

/// Adds the data of a GET_JOINT_STATUS reply: per joint temperature [°C], current [A], voltage [V], load [%], error.
pub fn put_drives(out: &mut Vec<u8>, drives: impl IntoIterator<Item = ([f32; 4], u16)>) {
    for (values, error) in drives {
        put_floats(out, &values);
        out.extend(error.to_le_bytes());
    }
}

/// Adds the data of a GET_IO reply.
pub fn put_io(out: &mut Vec<u8>, inputs: u16, outputs: u16, volts: [[f32; 2]; 2]) {
    out.extend(inputs.to_le_bytes());
    out.extend(outputs.to_le_bytes());
    out.extend(volts.as_flattened().iter().flat_map(|v| v.to_bits().to_le_bytes()));
}

#[cfg(test)]
mod tests {
    use super::super::super::golden::{self, JOINTS, POSE, bytes};
    use super::*;

    #[test]
    fn requests_are_read_from_the_golden_bytes() {
        let (joints, pose) = (JOINTS.map(|v| v as f32), POSE.map(|v| v as f32));
        for (golden, opcode, sequence, request) in [
            (golden::HELLO, 0x01, 1, Request::Hello),
            (golden::GET_STATE, 0x02, 2, Request::GetState(false)),
            (golden::GET_STATE_AND_FORCE, 0x02, 21, Request::GetState(true)),
            (golden::SET_MODE, 0x03, 3, Request::SetMode(1)),
            (golden::ENABLE, 0x04, 4, Request::Enable(true)),
            (golden::CLEAR_ERROR, 0x05, 5, Request::ClearError),
            (golden::STOP, 0x06, 0xFFFE, Request::Stop),
            (golden::MOVE_JOINTS, 0x10, 7, Request::MoveJoints(25.0, joints)),
            (golden::SERVO_JOINTS, 0x11, 8, Request::ServoJoints(joints)),
            (golden::VELOCITY_JOINTS, 0x12, 9, Request::VelocityJoints([1.5, 0.0, 0.0, 0.0, 0.0, -90.0])),
            (golden::MOVE_CARTESIAN, 0x13, 10, Request::MoveCartesian(50.0, pose)),
            (golden::GRIPPER, 0x20, 11, Request::Gripper(42.5)),
            (golden::GRIP, 0x25, 22, Request::Grip(42.5, 12.5)),
            (golden::SET_PAYLOAD, 0x21, 15, Request::SetPayload(golden::LOAD.map(|v| v as f32))),
            (golden::GET_PAYLOAD, 0x22, 16, Request::GetPayload),
            (golden::SET_MOUNTING, 0x23, 17, Request::SetMounting([0.0, 0.0, 1.0])),
            (golden::GET_MOUNTING, 0x24, 18, Request::GetMounting),
            (golden::GET_JOINT_STATUS, 0x40, 19, Request::GetJointStatus),
            (golden::GET_OFFSETS, 0x41, 20, Request::GetOffsets),
            (golden::GET_IO, 0x30, 12, Request::GetIo),
            (golden::SET_DIGITAL, 0x31, 13, Request::SetDigital(3, true)),
            (golden::SET_ANALOG, 0x32, 14, Request::SetAnalog(1, 2.5)),
        ] {
            let frame = bytes(golden);
            let expected = Frame { opcode, sequence, request: Ok(request) };
            assert_eq!(scan(&frame), Scan::Take(frame.len(), expected));
            assert_eq!(scan(&frame[..frame.len() - 1]), Scan::More);
        }
    }

    #[test]
    fn setpoints_are_read_from_the_golden_bytes() {
        let bare = SetpointRequest {
            valid_ms: 0,
            time_us: 1,
            joints: JOINTS.map(|v| v as f32),
            velocities: [1.0, -2.0, 3.0, -4.0, 5.0, -6.0],
            accelerations: None,
            torques: None,
            gains: None,
        };
        let full = SetpointRequest {
            valid_ms: 40,
            time_us: 123_456_789,
            accelerations: Some([0.5, -0.5, 1.0, -1.0, 2.0, -2.0]),
            torques: Some([8.0, -7.0, 6.0, -5.0, 4.0, -3.0]),
            gains: Some([[100.0, 90.0, 80.0, 70.0, 60.0, 50.0], [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]]),
            ..bare
        };
        for (golden, sequence, request) in [(golden::SETPOINT, 23, full), (golden::SETPOINT_BARE, 24, bare)] {
            let frame = bytes(golden);
            let expected = Frame { opcode: 0x14, sequence, request: Ok(Request::Setpoint(request)) };
            assert_eq!(scan(&frame), Scan::Take(frame.len(), expected));
            let payload = &frame[8..frame.len() - 2];
            assert_eq!(understand(0x14, &payload[..payload.len() - 1]), Err(status::MALFORMED));
            assert_eq!(understand(0x14, &[payload, &[0]].concat()), Err(status::MALFORMED));
        }
        assert_eq!(understand(0x03, &[4]), Err(status::MALFORMED));
    }

    #[test]
    fn replies_are_the_golden_bytes() {
        let frame = |opcode, sequence| Frame { opcode, sequence, request: Err(0) };
        let mut out = Vec::new();
        reply(&mut out, &frame(1, 1), 0, |out| put_hello(out, "YOURARM-6", 6, [2, 1, 3], "YA6-00042"));
        assert_eq!(out, bytes(golden::HELLO_REPLY));
        let report = Report {
            time_us: 123_456_789,
            state: 2,
            mode: 1,
            enabled: true,
            estop: false,
            error: 0,
            joints: [JOINTS.map(|v| v as f32), [1.0, -2.0, 3.0, -4.0, 5.0, -6.0], [0.5, -0.5, 1.0, -1.0, 2.0, -2.0]],
            gripper: 42.5,
            pose: POSE.map(|v| v as f32),
            force: 12.25,
        };
        reply(&mut out, &frame(2, 2), 0, |out| put_report(out, &report, false));
        assert_eq!(out, bytes(golden::STATE_REPLY), "an older client asks for no force");
        reply(&mut out, &frame(2, 21), 0, |out| put_report(out, &report, true));
        assert_eq!(out, bytes(golden::STATE_AND_FORCE_REPLY));
        reply(&mut out, &frame(0x25, 22), status::OUT_OF_RANGE, |out| out.extend([0, 0]));
        assert_eq!(out, bytes(golden::GRIP_REFUSED));
        reply(&mut out, &frame(3, 3), status::MOVING, |out| out.extend([0, 0]));
        assert_eq!(out, bytes(golden::MOVING_REPLY));
        reply(&mut out, &frame(0x11, 8), status::IN_ERROR, |out| out.extend([2, 0]));
        assert_eq!(out, bytes(golden::IN_ERROR_REPLY));
        reply(&mut out, &frame(0x30, 12), 0, |out| put_io(out, 0xFD, 8, [[1.5, -0.25], [0.0, 2.5]]));
        assert_eq!(out, bytes(golden::IO_REPLY));
        reply(&mut out, &frame(0x22, 16), 0, |out| put_floats(out, &golden::LOAD.map(|v| v as f32)));
        assert_eq!(out, bytes(golden::PAYLOAD_REPLY));
        reply(&mut out, &frame(0x24, 18), 0, |out| put_floats(out, &[0.0, 0.0, -1.0]));
        assert_eq!(out, bytes(golden::MOUNTING_REPLY));
        let drive = |i: u8| {
            let load = if i == 2 { -12.5 } else { 5.0 };
            ([30.5 + f32::from(i), 0.25 * f32::from(i), 48.0, load], if i == 5 { 7 } else { 0 })
        };
        reply(&mut out, &frame(0x40, 19), 0, |out| put_drives(out, (0..6).map(drive)));
        assert_eq!(out, bytes(golden::JOINT_STATUS_REPLY));
        reply(&mut out, &frame(0x41, 20), 0, |out| put_floats(out, &golden::OFFSETS.map(|v| v as f32)));
        assert_eq!(out, bytes(golden::OFFSETS_REPLY));
        reply(&mut out, &frame(0x31, 13), status::NO_CHANNEL, |out| out.extend([0, 0]));
        assert_eq!(out, bytes(golden::NO_CHANNEL_REPLY));
        reply(&mut out, &frame(6, 0xFFFE), 0, |_| ());
        assert_eq!(out, bytes(golden::STOP_REPLY));
    }

    #[test]
    fn what_is_not_on_the_sheet_is_refused() {
        assert_eq!(understand(0x77, &[]), Err(status::UNKNOWN_COMMAND));
        assert_eq!(understand(0x14, &[]), Err(status::MALFORMED));
        assert_eq!(understand(0x06, &[0]), Err(status::MALFORMED));
        assert_eq!(understand(0x31, &[0, 2]), Err(status::MALFORMED));
        assert_eq!(understand(0x32, &[]), Err(status::MALFORMED));
        assert_eq!(understand(0x11, &[0; 20]), Err(status::MALFORMED));
        assert_eq!(understand(0x02, &[2]), Err(status::MALFORMED));
        assert_eq!(understand(0x25, &[0; 4]), Err(status::MALFORMED));
        assert_eq!(understand(0x20, &f32::NAN.to_le_bytes()), Err(status::MALFORMED));
        assert_eq!(scan(b"xYA"), Scan::Skip(1));
    }
}
