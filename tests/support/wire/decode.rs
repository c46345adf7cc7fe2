//! Commands out of bytes, by the arms' protocol sheets alone: none of this calls an adapter's or emulator's own code.

use std::collections::VecDeque;
use std::sync::Arc;

use dimos::hardware::transport::can::CanFrame;
use serde_json::Value;

use super::{Decoder, NewDecoder, What};

/// What the received bytes begin with.
enum Front {
    /// Not all of it is there yet.
    More,
    /// This number of bytes is no frame.
    Skip(usize),
    /// A frame of this length, and its command, if any.
    Frame(usize, Option<What>),
}

/// A decoder from a function that examines the front.
fn by(look: impl FnMut(&[u8]) -> Front + Send + Sync + Clone + 'static) -> NewDecoder {
    Arc::new(move || -> Decoder {
        let (mut look, mut bytes) = (look.clone(), VecDeque::new());
        Box::new(move |new, found| {
            bytes.extend(new);
            loop {
                match look(bytes.make_contiguous()) {
                    Front::More => break,
                    Front::Skip(n) => drop(bytes.drain(..n)),
                    Front::Frame(n, what) => {
                        bytes.drain(..n);
                        found.extend(what);
                    }
                }
            }
        })
    })
}

fn floats(bytes: &[u8], of: fn([u8; 4]) -> f32) -> Vec<f64> {
    bytes.as_chunks::<4>().0.iter().map(|b| f64::from(of(*b))).collect()
}

fn radians(degrees: Vec<f64>) -> Vec<f64> {
    degrees.into_iter().map(f64::to_radians).collect()
}

/// `docs/yourarm-protocol.md`: little-endian, degrees, CRC-16/CCITT-FALSE.
pub fn yourarm() -> NewDecoder {
    by(|bytes| {
        match bytes {
            [] | [0x59] => return Front::More,
            [0x59, 0x41, ..] => {}
            _ => return Front::Skip(1),
        }
        let Some(length) = bytes.get(6..8).map(|b| usize::from(u16::from_le_bytes([b[0], b[1]]))) else {
            return Front::More;
        };
        if length > 256 {
            return Front::Skip(1);
        }
        let Some(frame) = bytes.get(..8 + length + 2) else { return Front::More };
        let (body, check) = frame.split_at(8 + length);
        if crc16(body) != u16::from_le_bytes([check[0], check[1]]) {
            return Front::Skip(1);
        }
        let payload = &body[8..];
        let what = match (body[3], payload) {
            (0x03, [mode]) => Some(What::Mode(mode.to_string())),
            (0x04, [on]) => Some(What::Enable(*on == 1)),
            (0x06, []) => Some(What::Stop),
            (0x10, [_, _, _, _, target @ ..]) => Some(What::Planned(radians(floats(target, f32::from_le_bytes)))),
            (0x11, target) => Some(What::Position(radians(floats(target, f32::from_le_bytes)))),
            (0x12, target) => Some(What::Velocity(radians(floats(target, f32::from_le_bytes)))),
            // Flags, validity and time, then positions and what is beside them.
            (0x14, [_, _, _, _, _, _, _, _, _, _, _, rest @ ..]) if rest.len() >= 48 => {
                Some(What::Position(radians(floats(&rest[..24], f32::from_le_bytes))))
            }
            _ => None,
        };
        Front::Frame(frame.len(), what)
    })
}

fn crc16(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0xFFFF, |crc, byte| {
        (0..8).fold(crc ^ (u16::from(*byte) << 8), |crc, _| match crc & 0x8000 {
            0 => crc << 1,
            _ => (crc << 1) ^ 0x1021,
        })
    })
}

/// xArm's control port: a big-endian header, registers, little-endian floats in radians. Seven joints always go over
/// the wire; `dof` of them count.
pub fn xarm(dof: usize) -> NewDecoder {
    by(move |bytes| {
        let Some(header) = bytes.first_chunk::<6>() else { return Front::More };
        let (protocol, length) =
            (u16::from_be_bytes([header[2], header[3]]), usize::from(u16::from_be_bytes([header[4], header[5]])));
        if !matches!(protocol, 2 | 3) || length == 0 || length > 1024 {
            return Front::Skip(1);
        }
        let Some(frame) = bytes.get(..6 + length) else { return Front::More };
        let joints = |payload: &[u8]| floats(payload, f32::from_le_bytes).into_iter().take(dof).collect::<Vec<_>>();
        let what = match (frame[6], &frame[7..]) {
            (11, [_, on]) => Some(What::Enable(*on == 1)),
            (12, [4 | 6]) => Some(What::Stop),
            (12, [state]) => Some(What::Mode(format!("state {state}"))),
            (19, [mode, ..]) => Some(What::Mode(mode.to_string())),
            (23, payload) => Some(What::Planned(joints(payload))),
            (29, payload) => Some(What::Position(joints(payload))),
            (81, payload) => Some(What::Velocity(joints(payload))),
            _ => None,
        };
        Front::Frame(frame.len(), what)
    })
}

/// RTDE of Universal Robots: a length, a type, for data the number of a recipe, and big-endian values. The first recipe
/// of this adapter has a count, an order and six joints. After a stop another program begins.
pub fn ur() -> NewDecoder {
    by(|bytes| {
        let Some([high, low, kind]) = bytes.first_chunk::<3>() else { return Front::More };
        let length = usize::from(u16::from_be_bytes([*high, *low]));
        if length < 3 {
            return Front::Skip(1);
        }
        let Some(frame) = bytes.get(..length) else { return Front::More };
        let joints = || frame[12..].as_chunks::<8>().0.iter().map(|b| f64::from_be_bytes(*b)).collect();
        let what = match (kind, length, frame.get(11)) {
            (b'U', 60, Some(1)) => Some(What::Position(joints())),
            (b'U', 60, Some(2)) => Some(What::Velocity(joints())),
            (b'U', 60, Some(3)) => Some(What::Enable(false)),
            _ => None,
        };
        Front::Frame(length, what)
    })
}

/// `docs/remote-adapter.md`: a JSON object a line.
pub fn remote() -> NewDecoder {
    by(|bytes| {
        let Some(end) = bytes.iter().position(|b| *b == b'\n') else { return Front::More };
        let Ok(line) = serde_json::from_slice::<Value>(&bytes[..end]) else { return Front::Skip(end + 1) };
        let numbers = |v: &Value| v.as_array().into_iter().flatten().filter_map(Value::as_f64).collect::<Vec<_>>();
        let what = match line["do"].as_str() {
            Some("cycle") => match line["command"]["mode"].as_str() {
                Some("velocity") => Some(What::Velocity(numbers(&line["command"]["values"]))),
                Some(_) => Some(What::Position(numbers(&line["command"]["values"]))),
                None => None,
            },
            Some("activate") => Some(What::Enable(true)),
            Some("write_enable") => Some(What::Enable(line["args"][0] == true)),
            Some("set_control_mode") => line["args"][0].as_str().map(|mode| What::Mode(mode.to_owned())),
            Some("write_stop") => Some(What::Stop),
            _ => None,
        };
        Front::Frame(end + 1, what)
    })
}

/// The template of an arm on a stream of bytes (the sheet in `assets/templates/tcp/protocol.rs`): big-endian floats
/// in degrees, a sum at the end.
pub fn template() -> NewDecoder {
    by(|bytes| {
        let Some([start, opcode, _, length]) = bytes.first_chunk::<4>() else {
            return if matches!(bytes, [] | [0xA5, ..]) { Front::More } else { Front::Skip(1) };
        };
        if *start != 0xA5 {
            return Front::Skip(1);
        }
        let Some(frame) = bytes.get(..4 + usize::from(*length) + 2) else { return Front::More };
        let (body, check) = frame.split_at(frame.len() - 2);
        let sum = body.iter().fold(0_u16, |sum, b| sum.wrapping_add(u16::from(*b)));
        if sum != u16::from_be_bytes([check[0], check[1]]) {
            return Front::Skip(1);
        }
        let what = match (opcode, &body[4..]) {
            (0x03, [mode]) => Some(What::Mode(mode.to_string())),
            (0x04, [on]) => Some(What::Enable(*on == 1)),
            (0x06, []) => Some(What::Stop),
            (0x10, [_, _, _, _, target @ ..]) => Some(What::Planned(radians(floats(target, f32::from_be_bytes)))),
            (0x11, target) => Some(What::Position(radians(floats(target, f32::from_be_bytes)))),
            (0x12, target) => Some(What::Velocity(radians(floats(target, f32::from_be_bytes)))),
            _ => None,
        };
        Front::Frame(frame.len(), what)
    })
}

/// Feetech's bus servos: a goal for each servo in one packet to all, or in one to each, which then counts with the last
/// goals of the others. Positions begin with the middle of a turn, 4096 to a turn; homing offsets are zero where a test
/// begins.
pub fn so101() -> NewDecoder {
    let mut goals = [None; 5];
    by(move |bytes| {
        let Some([0xFF, 0xFF, id, length]) = bytes.first_chunk::<4>() else {
            return if matches!(bytes, [] | [0xFF] | [0xFF, 0xFF, ..]) && bytes.len() < 4 {
                Front::More
            } else {
                Front::Skip(1)
            };
        };
        let Some(body) = bytes.get(4..4 + usize::from(*length)) else { return Front::More };
        let angle = |b: [u8; 2]| (f64::from(u16::from_le_bytes(b)) - 2048.0) / 4096.0 * std::f64::consts::TAU;
        let mut take = |id: u8, goal: &[u8]| {
            if let (Some(of), [low, high, ..]) = (goals.get_mut(usize::from(id).wrapping_sub(1)), goal) {
                *of = Some(angle([*low, *high]));
            }
        };
        // In motion the acceleration, register 41, is before the goal.
        let is_goal = match body {
            [0x83, first @ 41..=42, size, servos @ .., _] => {
                for servo in servos.chunks_exact(usize::from(*size) + 1) {
                    take(servo[0], &servo[1 + usize::from(42 - first)..]);
                }
                true
            }
            [0x03, first @ 41..=42, goal @ .., _] => {
                take(*id, &goal[usize::from(42 - first)..]);
                *id <= 5
            }
            _ => false,
        };
        let what = match body {
            _ if is_goal => goals.iter().copied().collect::<Option<Vec<f64>>>().map(What::Position),
            [0x83, 40, 1, torques @ .., _] => Some(What::Enable(torques.get(1) == Some(&1))),
            _ => None,
        };
        Front::Frame(4 + body.len(), what)
    })
}

/// A Piper's CAN frames, assembled to setpoints: 0x155 to 0x157 carry two joints each, big-endian in 0.001°.
pub fn piper() -> impl FnMut(&CanFrame) -> Option<What> + Send {
    let mut joints = [None; 6];
    move |frame| {
        let pair = |at: usize| {
            i32::from_be_bytes([frame.data[at], frame.data[at + 1], frame.data[at + 2], frame.data[at + 3]])
        };
        match frame.id {
            0x150 if frame.data[0] == 1 => Some(What::Stop),
            0x151 => Some(What::Mode(format!("{} {}", frame.data[0], frame.data[1]))),
            0x471 => Some(What::Enable(frame.data[1] == 2)),
            0x155..=0x157 => {
                let first = 2 * usize::from(frame.id - 0x155);
                joints[first] = Some((f64::from(pair(0)) * 1e-3).to_radians());
                joints[first + 1] = Some((f64::from(pair(4)) * 1e-3).to_radians());
                let whole: Option<Vec<f64>> = joints.iter().copied().collect();
                whole.filter(|_| frame.id == 0x157).map(What::Position)
            }
            _ => None,
        }
    }
}
