//! The emulator: plays the controller on a pseudo-terminal, for `address: sim` and for tests.
//!
//! It has its own reading of the sheet in `protocol.rs` and shares no code with it: an emulator that shared the adapter's
//! encoders would share its mistakes. YOUR ARM: change it as you change `protocol.rs`. What the arm itself does, its
//! joints, motors, errors and faults, is in `SimArm`.

use dimos::clock::{Clock, Mono, MonotonicClock};
use dimos::hardware::registry::{AdapterConfig, Emulator, Place};
use dimos::hardware::sim::arm::{Delivery, Refusal, SimArm};
use dimos::hardware::sim::faults::{Fault, FaultKind, check_kind};
use dimos::hardware::sim::serial_server::SerialServer;
use dimos::hardware::sim::stream::Controller;
use dimos::hardware::spec::AdapterResult;
use dimos::hardware::transport::serial::Scan;
use dimos::joint::{ControlMode, Joints, MAX_DOF};

use super::{DOF, Options, limits};

/// In velocity mode the arm stops when no velocity arrives for this long [s].
const VELOCITY_TIMEOUT: f64 = 0.2;

/// The faults that the emulator can play: integers are never NaN.
pub const PLAYABLE: &[FaultKind] = &[
    FaultKind::Stall,
    FaultKind::Silent,
    FaultKind::Disconnect,
    FaultKind::ErrorCode,
    FaultKind::Estop,
    FaultKind::PowerLoss,
    FaultKind::ZeroState,
    FaultKind::Garbage,
    FaultKind::Corrupt,
    FaultKind::Truncated,
    FaultKind::WrongDof,
    FaultKind::Sag,
    FaultKind::Blocked,
];

/// A running emulator. Ends when it is dropped.
pub struct AcmeEmulator(SerialServer<AcmeController>);

impl AcmeEmulator {
    /// Starts an emulator at `place`, with the `sim` part of the arm's options.
    pub fn start(config: &AdapterConfig, place: &Place) -> AdapterResult<Self> {
        let (options, limits) = (config.options::<Options>()?.sim, limits());
        options.check("acme", &limits, PLAYABLE)?;
        let arm = SimArm::new(&limits, &options, VELOCITY_TIMEOUT, MonotonicClock.now());
        SerialServer::start("acme", AcmeController { arm }, place).map(Self)
    }
}

impl Emulator for AcmeEmulator {
    fn address(&self) -> String {
        self.0.path().to_owned()
    }

    fn inject(&self, fault: Fault) -> Result<(), String> {
        check_kind("the acme emulator", &fault, PLAYABLE)?;
        self.0.with(|controller, now| controller.arm.inject(fault, now));
        Ok(())
    }

    fn true_positions(&self) -> Option<Joints> {
        self.0.with(|controller, now| {
            controller.arm.advance(now);
            Some(controller.arm.joints().0)
        })
    }
}

/// The controller: requests in, what the arm makes of them, replies out.
struct AcmeController {
    arm: SimArm,
}

impl Controller for AcmeController {
    fn serve(&mut self, bytes: &[u8], now: Mono, answer: &mut Vec<u8>) -> Scan<Delivery> {
        let request = match scan(bytes) {
            Scan::More => return Scan::More,
            Scan::Skip(n) => return Scan::Skip(n),
            Scan::Take(n, request) => (n, request),
        };
        let (length, Request { opcode, payload }) = request;
        self.arm.advance(now);
        let mut data = Vec::with_capacity(256);
        let status = self.execute(opcode, payload, &mut data).err().unwrap_or(0);
        reply(answer, opcode, status, &data);
        Scan::Take(length, self.arm.delivery())
    }

    fn client_gone(&mut self, now: Mono) {
        self.arm.client_gone(now);
    }
}

impl AcmeController {
    /// Does what a request asks; an error is the status of the reply.
    fn execute(&mut self, opcode: u8, payload: &[u8], data: &mut Vec<u8>) -> Result<(), u8> {
        let arm = &mut self.arm;
        match (opcode, payload) {
            (0x01, []) => {
                arm.client_came();
                put_hello(data, arm.claimed_dof() as u8);
                Ok(())
            }
            (0x02, []) => {
                put_state(data, arm);
                Ok(())
            }
            (0x03, [mode @ 0..=2]) => arm.set_mode(match mode {
                0 => ControlMode::Position,
                1 => ControlMode::ServoPosition,
                _ => ControlMode::Velocity,
            }),
            (0x04, [on @ 0..=1]) => arm.enable(*on == 1),
            (0x05, []) => arm.clear_error(),
            (0x06, []) => {
                arm.stop();
                Ok(())
            }
            (0x10, [speed @ 1..=100, target @ ..]) => arm.move_to(&radians(target)?, f64::from(*speed) / 100.0),
            (0x11, target) => arm.servo(&radians(target)?),
            (0x12, velocities) => arm.velocity(&radians(velocities)?),
            (0x01..=0x06 | 0x10, _) => return Err(2),
            _ => return Err(1),
        }
        .map_err(|refusal| match refusal {
            Refusal::Disabled => 3,
            Refusal::WrongMode => 4,
            Refusal::Moving => 5,
            Refusal::OutOfRange => 6,
            Refusal::InError => 7,
        })
    }
}

// --- Bytes ---

#[derive(Debug, PartialEq)]
struct Request<'a> {
    opcode: u8,
    payload: &'a [u8],
}

/// Finds a request at the front of what has arrived.
fn scan(bytes: &[u8]) -> Scan<Request<'_>> {
    let &[start, opcode, length, ref rest @ ..] = bytes else {
        return if matches!(bytes, [] | [0xAA, ..]) { Scan::More } else { Scan::Skip(1) };
    };
    if start != 0xAA {
        return Scan::Skip(1);
    }
    let length = length as usize;
    let (Some(payload), Some(&last)) = (rest.get(..length), rest.get(length)) else { return Scan::More };
    if checksum(bytes.iter().take(3 + length)) != last {
        return Scan::Skip(1);
    }
    Scan::Take(length + 4, Request { opcode, payload })
}

fn reply(out: &mut Vec<u8>, opcode: u8, status: u8, data: &[u8]) {
    out.extend([0x55, opcode, data.len() as u8 + 1, status]);
    out.extend(data);
    let last = checksum(out.iter());
    out.push(last);
}

fn checksum<'a>(bytes: impl Iterator<Item = &'a u8>) -> u8 {
    255 - (bytes.map(|byte| *byte as u32).sum::<u32>() % 256) as u8
}

/// A number per joint [0.001 deg or 0.001 deg/s] as [rad or rad/s].
fn radians(bytes: &[u8]) -> Result<[f64; DOF], u8> {
    let (chunks, rest) = bytes.as_chunks::<4>();
    let mut out = [0.0; DOF];
    out.iter_mut().zip(chunks).for_each(|(to, chunk)| {
        *to = (f64::from(u32::from_le_bytes(*chunk) as i32) * 0.001).to_radians();
    });
    if chunks.len() == DOF && rest.is_empty() { Ok(out) } else { Err(2) }
}

fn put_hello(out: &mut Vec<u8>, dof: u8) {
    out.extend([1, dof, 2, 1, 42, 0, 0, 0]);
}

fn put_state(out: &mut Vec<u8>, arm: &mut SimArm) {
    let measured = arm.measured();
    let mode = match arm.mode() {
        ControlMode::Position => 0,
        ControlMode::ServoPosition => 1,
        _ => 2,
    };
    let flags = u8::from(arm.enabled()) + 2 * u8::from(arm.moving());
    let joints = [measured.positions.map(thousandths), measured.velocities.map(thousandths)];
    put_values(out, arm.uptime().as_millis() as u32, flags, mode, arm.error(), &joints);
}

/// [rad] as [0.001 deg].
fn thousandths(value: f64) -> i32 {
    (value * 180_000.0 / std::f64::consts::PI).round() as i32
}

fn put_values(out: &mut Vec<u8>, time_ms: u32, flags: u8, mode: u8, error: u16, joints: &[[i32; MAX_DOF]; 2]) {
    out.extend(time_ms.to_le_bytes());
    out.extend([flags, mode, error as u8, (error >> 8) as u8]);
    for value in joints.iter().flat_map(|values| values.iter().take(DOF)) {
        out.extend([0, 8, 16, 24].map(|shift| (value >> shift) as u8));
    }
}

#[cfg(test)]
mod tests {
    use super::super::golden::{self, JOINTS, bytes};
    use super::*;

    #[test]
    fn requests_are_read_from_the_golden_bytes() {
        for (golden, opcode, payload) in [
            (golden::HELLO, 0x01, &[][..]),
            (golden::STATE, 0x02, &[]),
            (golden::MODE, 0x03, &[1]),
            (golden::ENABLE, 0x04, &[1]),
            (golden::CLEAR, 0x05, &[]),
            (golden::STOP, 0x06, &[]),
        ] {
            let frame = bytes(golden);
            assert_eq!(scan(&frame), Scan::Take(frame.len(), Request { opcode, payload }));
            assert_eq!(scan(&frame[..frame.len() - 1]), Scan::More);
        }
        let frame = golden::of_joints("aa11", "", 1);
        let Scan::Take(_, request) = scan(&frame) else { panic!("no request") };
        let joints = radians(request.payload).unwrap();
        assert!(joints.iter().zip(JOINTS).all(|(found, (value, _))| thousandths(*found) == value), "{joints:?}");
        assert_eq!(radians(&request.payload[1..]), Err(2));
    }

    #[test]
    fn replies_are_the_golden_bytes() {
        let of = |opcode, status, data: &[u8]| {
            let mut out = Vec::new();
            reply(&mut out, opcode, status, data);
            out
        };
        let mut data = Vec::new();
        put_hello(&mut data, 6);
        assert_eq!(of(0x01, 0, &data), bytes(golden::HELLO_REPLY));
        assert_eq!(of(0x03, 5, &[]), bytes(golden::MOVING_REPLY));
        let mut data = Vec::new();
        put_values(&mut data, 123_456, 3, 1, 2, &[JOINTS.map(|(value, _)| value); 2]);
        assert_eq!(of(0x02, 0, &data), golden::of_joints("5502", golden::STATE_BEFORE_JOINTS, 2));
        assert_eq!(thousandths(-20.0_f64.to_radians()), -20_000);
    }
}
