//! The emulator: the controller's side of the protocol, for `address: sim` and for tests.
//!
//! It is written from the sheet in `protocol.rs` and shares no code with it: two sides that share an encoder share its
//! mistakes. YOUR ARM: change it as you change `protocol.rs`. `SimArm` is the arm: joints, motors, errors, faults.

use dimos_hardware::adapter::AdapterResult;
use dimos_hardware::clock::{Clock, Mono, MonotonicClock};
use dimos_hardware::joint::{ControlMode, Joints};
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos_hardware::sim::arm::{Delivery, HasArm, PLAYABLE, Refusal, SimArm};
use dimos_hardware::sim::faults::FaultKind;
use dimos_hardware::sim::stream::Controller;
use dimos_hardware::transport::Scan;

use super::{DOF, Options, limits, wire};

/// In velocity mode the arm stops when no velocity arrives within this time [s].
const VELOCITY_TIMEOUT: f64 = 0.2;

/// Starts an emulator at `place`, with the `sim` part of the arm's options. It runs until it is dropped.
pub fn start(config: &AdapterConfig, place: &EmulatorAddress) -> AdapterResult<Box<dyn Emulator>> {
    let options: Options = config.options()?;
    let arm = SimArm::new("acme", &limits(), &options.sim, PLAYABLE, MonotonicClock.now())?;
    let controller = AcmeController { arm: arm.with_velocity_timeout(VELOCITY_TIMEOUT), state: Vec::new() };
    Ok(Box::new(wire::serve(controller, place)?))
}

/// The controller: executes requests and replies.
struct AcmeController {
    arm: SimArm,
    /// Data of the last reply to STATE, for the fault `frozen`.
    state: Vec<u8>,
}

impl HasArm for AcmeController {
    fn arm(&mut self) -> &mut SimArm {
        &mut self.arm
    }
}

impl Controller for AcmeController {
    fn serve(&mut self, bytes: &[u8], now: Mono, answer: &mut Vec<u8>) -> Scan<Delivery> {
        scan(bytes).map(|Request { opcode, number, payload }| {
            self.arm.advance(now);
            let mut data = Vec::with_capacity(256);
            let status = self.execute(opcode, payload, &mut data).err().unwrap_or(0);
            reply(answer, opcode, number, status, &data);
            self.arm.delivery()
        })
    }

    fn client_gone(&mut self, now: Mono) {
        self.arm.client_gone(now);
    }

    fn turn_away(&self, bytes: &[u8], answer: &mut Vec<u8>) {
        if let Scan::Take(_, request) = scan(bytes) {
            reply(answer, request.opcode, request.number, 8, &[]);
        }
    }
}

impl AcmeController {
    /// Executes a request; an error is the status of the reply.
    fn execute(&mut self, opcode: u8, payload: &[u8], data: &mut Vec<u8>) -> Result<(), u8> {
        let arm = &mut self.arm;
        match (opcode, payload) {
            (0x01, []) => {
                arm.client_came();
                let model = 1 + u8::from(arm.take_fault(FaultKind::WrongModel).is_some());
                put_hello(data, model, arm.claimed_dof() as u8);
                Ok(())
            }
            (0x02, []) => {
                if self.state.is_empty() || arm.take_fault(FaultKind::Frozen).is_none() {
                    self.state.clear();
                    put_state(&mut self.state, arm);
                }
                data.extend(&self.state);
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
            (0x10, [_, _, _, _, target @ ..]) => {
                let speed = numbers::<1>(payload.get(..4).unwrap_or_default())?;
                let target = radians(target)?;
                arm.move_to(&target, f64::from(speed[0]) / 100.0)
            }
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
    number: u8,
    payload: &'a [u8],
}

/// Finds a request at the front of the received bytes.
fn scan(bytes: &[u8]) -> Scan<Request<'_>> {
    let &[start, opcode, number, length, ref rest @ ..] = bytes else {
        return if matches!(bytes, [] | [0xA5, ..]) { Scan::More } else { Scan::Skip(1) };
    };
    if start != 0xA5 {
        return Scan::Skip(1);
    }
    let length = length as usize;
    let (Some(payload), Some(&[high, low])) = (rest.get(..length), rest.get(length..length + 2)) else {
        return Scan::More;
    };
    if checksum(bytes.iter().take(4 + length)) != (high, low) {
        return Scan::Skip(1);
    }
    Scan::Take(length + 6, Request { opcode, number, payload })
}

fn reply(out: &mut Vec<u8>, opcode: u8, number: u8, status: u8, data: &[u8]) {
    out.extend([0x5A, opcode, number, data.len() as u8 + 1, status]);
    out.extend(data);
    let (high, low) = checksum(out.iter());
    out.extend([high, low]);
}

fn checksum<'a>(bytes: impl Iterator<Item = &'a u8>) -> (u8, u8) {
    let sum = bytes.map(|byte| *byte as u32).sum::<u32>();
    ((sum >> 8) as u8, sum as u8)
}

/// Decodes exactly N finite numbers.
fn numbers<const N: usize>(bytes: &[u8]) -> Result<[f32; N], u8> {
    let (chunks, rest) = bytes.as_chunks::<4>();
    let mut out = [0.0; N];
    out.iter_mut().zip(chunks).for_each(|(to, chunk)| *to = f32::from_bits(u32::from_be_bytes(*chunk)));
    if chunks.len() == N && rest.is_empty() && out.iter().all(|value| value.is_finite()) { Ok(out) } else { Err(2) }
}

/// Decodes one number per joint [deg or deg/s] and converts it to [rad or rad/s].
fn radians(bytes: &[u8]) -> Result<[f64; DOF], u8> {
    Ok(numbers::<DOF>(bytes)?.map(|degrees| f64::from(degrees).to_radians()))
}

fn put_hello(out: &mut Vec<u8>, model: u8, dof: u8) {
    out.extend([0, model, dof, 2, 1, 0, 0, 0, 42]);
}

fn put_state(out: &mut Vec<u8>, arm: &mut SimArm) {
    let measured = arm.measured();
    let mode = match arm.mode() {
        ControlMode::Position => 0,
        ControlMode::ServoPosition => 1,
        _ => 2,
    };
    let flags = u8::from(arm.enabled()) + 2 * u8::from(arm.moving());
    let degrees = |joints: Joints| joints.map(f64::to_degrees);
    let joints = [degrees(measured.positions), degrees(measured.velocities), measured.efforts];
    put_values(out, arm.uptime().as_micros() as u64, flags, mode, arm.error(), &joints);
}

fn put_values(out: &mut Vec<u8>, time_us: u64, flags: u8, mode: u8, error: u16, joints: &[Joints; 3]) {
    out.extend(time_us.to_be_bytes());
    out.extend([flags, mode, (error >> 8) as u8, error as u8]);
    for value in joints.iter().flat_map(|values| values.iter().take(DOF)) {
        out.extend((*value as f32).to_bits().to_be_bytes());
    }
}

#[cfg(test)]
mod tests {
    use super::super::golden::{self, JOINTS, bytes};
    use super::*;

    #[test]
    fn requests_are_read_from_the_golden_bytes() {
        for (golden, opcode, number, payload) in [
            (golden::HELLO, 0x01, 1, &[][..]),
            (golden::STATE, 0x02, 2, &[]),
            (golden::MODE, 0x03, 3, &[1]),
            (golden::ENABLE, 0x04, 4, &[1]),
            (golden::CLEAR, 0x05, 5, &[]),
            (golden::STOP, 0x06, 255, &[]),
        ] {
            let frame = bytes(golden);
            assert_eq!(scan(&frame), Scan::Take(frame.len(), Request { opcode, number, payload }));
            assert_eq!(scan(&frame[..frame.len() - 1]), Scan::More);
        }
        let frame = golden::of_joints("a51108", "", 1);
        let Scan::Take(_, request) = scan(&frame) else { panic!("no request") };
        let joints = numbers::<DOF>(request.payload).unwrap();
        assert!(joints.iter().zip(JOINTS).all(|(found, (degrees, _))| f64::from(*found) == degrees), "{joints:?}");
        assert_eq!(numbers::<DOF>(&request.payload[1..]), Err(2));
    }

    #[test]
    fn replies_are_the_golden_bytes() {
        let of = |opcode, number, status, data: &[u8]| {
            let mut out = Vec::new();
            reply(&mut out, opcode, number, status, data);
            out
        };
        let mut data = Vec::new();
        put_hello(&mut data, 1, 6);
        assert_eq!(of(0x01, 1, 0, &data), bytes(golden::HELLO_REPLY));
        assert_eq!(of(0x03, 3, 5, &[]), bytes(golden::MOVING_REPLY));
        let mut data = Vec::new();
        put_values(&mut data, 123_456_789, 3, 1, 2, &[JOINTS.map(|(degrees, _)| degrees); 3]);
        assert_eq!(of(0x02, 2, 0, &data), golden::of_joints("5a0202", golden::STATE_BEFORE_JOINTS, 3));
    }
}
