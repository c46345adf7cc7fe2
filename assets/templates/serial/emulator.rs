//! The emulator: the servos' side of the protocol, for `address: sim` and for tests.
//!
//! It is written from the sheet in `protocol.rs` and shares no code with it: two sides that share an encoder share its
//! mistakes. YOUR ARM: change it as you change `protocol.rs`. `SimArm` is the arm: joints, motors, errors, faults.

use std::f64::consts::TAU;

use dimos_hardware::adapter::AdapterResult;
use dimos_hardware::clock::{Clock, Mono, MonotonicClock};
use dimos_hardware::joint::Joints;
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress, Truth};
use dimos_hardware::sim::arm::{Delivery, HasArm, SimArm};
use dimos_hardware::sim::faults::FaultKind;
use dimos_hardware::sim::gripper::Gripper;
use dimos_hardware::sim::stream::Controller;
use dimos_hardware::transport::Scan;

use super::calibration::Calibration;
use super::{DOF, OPEN, Options, SERVOS, TOP_SPEED, limits, wire};

/// The faults that the servos can play. YOUR ARM: leave out what yours cannot have.
pub const PLAYABLE: &[FaultKind] = &[
    FaultKind::Stall,
    FaultKind::Silent,
    FaultKind::LostCommand,
    FaultKind::Disconnect,
    FaultKind::ErrorCode,
    FaultKind::PowerLoss,
    FaultKind::Garbage,
    FaultKind::Corrupt,
    FaultKind::Truncated,
    FaultKind::WrongModel,
    FaultKind::Blocked,
    FaultKind::Pushed,
    FaultKind::MotorOff,
];
/// Counts between closed and open, and when closed; the gripper's speed [1/s]. YOUR ARM
const GRIPPER: (f64, f64) = (2000.0, 1000.0);
const GRIPPER_SPEED: f64 = 2.0;

/// Starts an emulator at `place`, with the `sim` part of the arm's options. It runs until it is dropped.
pub fn start(config: &AdapterConfig, place: &EmulatorAddress) -> AdapterResult<Box<dyn Emulator>> {
    let options: Options = config.options()?;
    let now = MonotonicClock.now();
    let arm = SimArm::new("acme", &limits(&Calibration::default()), &options.sim, PLAYABLE, now)?.without_modes();
    let gripper = Gripper::new(1.0, GRIPPER_SPEED);
    let angles = arm.joints().0;
    let mut servos = Servos { arm, gripper, grips: false, goals: [0; SERVOS], angles, echo: options.echo, now };
    servos.goals = servos.positions();
    Ok(Box::new(wire::serve(servos, place)?))
}

/// The servos on their line.
struct Servos {
    arm: SimArm,
    /// The gripper, from 0 to 1, and whether its motor is on.
    gripper: Gripper,
    grips: bool,
    /// [counts]
    goals: [u16; SERVOS],
    /// The same for the joints [rad]. One that is enabled at its goal stays, and does not move by less than a count.
    angles: Joints,
    /// Whether the line returns what is sent.
    echo: bool,
    now: Mono,
}

impl HasArm for Servos {
    fn arm(&mut self) -> &mut SimArm {
        &mut self.arm
    }

    fn complete(&self, truth: &mut Truth) {
        truth.gripper_position = Some(self.gripper.position * OPEN);
    }
}

impl Controller for Servos {
    fn serve(&mut self, bytes: &[u8], now: Mono, answer: &mut Vec<u8>) -> Scan<Delivery> {
        let Frame { servo, opcode, payload, length } = match scan(bytes) {
            Scan::Take(_, frame) => frame,
            Scan::Skip(n) => return Scan::Skip(n),
            Scan::More => return Scan::More,
        };
        self.arm.client_came();
        self.arm.advance(now);
        self.gripper.advance(now.seconds_since(std::mem::replace(&mut self.now, now)));
        let lost = matches!((servo, opcode), (0, 0x03..)) && self.arm.loses_command();
        if !lost {
            self.execute(servo, opcode, payload, answer);
        }
        // Only what is answered can be lost.
        let delivery = if answer.is_empty() { Delivery::Send } else { self.arm.delivery() };
        if matches!(delivery, Delivery::PowerLoss(_)) {
            self.grips = false;
        }
        if self.echo {
            answer.splice(0..0, bytes.iter().take(length).copied());
        }
        Scan::Take(length, delivery)
    }

    /// Servos do not know their client.
    fn client_gone(&mut self, now: Mono) {
        self.arm.advance(now);
    }
}

impl Servos {
    fn positions(&self) -> [u16; SERVOS] {
        let mut counts = [GRIPPER.1 + self.gripper.position * GRIPPER.0; SERVOS];
        let angles = self.arm.joints().0;
        counts.iter_mut().take(DOF).zip(angles).for_each(|(to, angle)| *to = 2048.0 + angle * 4096.0 / TAU);
        counts.map(|value| value.round() as u16)
    }

    fn execute(&mut self, servo: u8, opcode: u8, payload: &[u8], answer: &mut Vec<u8>) {
        match (servo, opcode, payload) {
            (1.., 0x01, []) if usize::from(servo) <= SERVOS => {
                let model = 1 + u8::from(self.arm.take_fault(FaultKind::WrongModel).is_some());
                reply(answer, servo, 0, &[0, model, 2, 3]);
            }
            (0, 0x02, []) => self.report(answer),
            (0, 0x03, [on @ 0..=1]) => {
                let was = self.arm.enabled();
                (0..DOF).for_each(|joint| self.arm.enable_joint(joint, *on == 1));
                self.grips = *on == 1;
                if self.grips && !was {
                    let (here, true_angles) = (self.positions(), self.arm.joints().0);
                    for joint in (0..DOF).filter(|joint| self.goals[*joint] == here[*joint]) {
                        self.angles[joint] = true_angles[joint];
                    }
                    self.go(0.0);
                }
            }
            (0, 0x04, goals) if goals.len() == 4 * SERVOS => {
                let words =
                    |at: usize| goals.chunks_exact(4).map(move |four| u16::from_be_bytes([four[at], four[at + 1]]));
                for (servo, goal) in words(0).enumerate() {
                    let before = std::mem::replace(&mut self.goals[servo], goal);
                    if servo < DOF && before != goal {
                        self.angles[servo] = (f64::from(goal) - 2048.0) * TAU / 4096.0;
                    }
                }
                let speed = words(2).next().unwrap_or_default();
                self.go(f64::from(speed) * TAU / 4096.0 / TOP_SPEED);
            }
            (1.., 0x04, [g0, g1, s0, s1]) if usize::from(servo) <= SERVOS => {
                let servo = usize::from(servo) - 1;
                let goal = u16::from_be_bytes([*g0, *g1]);
                self.goals[servo] = goal;
                if servo == DOF {
                    return self.grip();
                }
                self.angles[servo] = (f64::from(goal) - 2048.0) * TAU / 4096.0;
                self.go(f64::from(u16::from_be_bytes([*s0, *s1])) * TAU / 4096.0 / TOP_SPEED);
            }
            (0, 0x05, []) => {
                let _ = self.arm.clear_error();
            }
            _ => {}
        }
    }

    /// Sends joints and gripper to their goals, at a fraction of the top speed; 0 for as fast as they can.
    fn go(&mut self, speed: f64) {
        if self.arm.error() != 0 {
            return;
        }
        if self.arm.enabled() {
            self.arm.take_goal(&self.angles[..DOF], if speed > 0.0 { speed.min(1.0) } else { 1.0 }, speed == 0.0);
        }
        self.grip();
    }

    /// Sends the gripper to its goal.
    fn grip(&mut self) {
        if self.grips && self.arm.error() == 0 {
            self.gripper.move_to((f64::from(self.goals[DOF]) - GRIPPER.1) / GRIPPER.0);
        }
    }

    /// The replies of all servos to STATE.
    fn report(&mut self, answer: &mut Vec<u8>) {
        let (positions, velocities) = (self.positions(), self.arm.joints().1);
        for (i, (position, goal)) in positions.into_iter().zip(self.goals).enumerate() {
            let joint = i < DOF;
            let velocity = if joint { velocities[i] * 4096.0 / TAU } else { 0.0 };
            let on = if joint { self.arm.motor(i) } else { self.grips };
            let moving = if joint { velocity.abs() > 3.0 } else { self.gripper.moving() };
            let error = self.arm.error_of(i) as u8;
            put_state(answer, i as u8 + 1, error, (on, moving), position, velocity.round() as i16, goal);
        }
    }
}

// --- Bytes ---

#[derive(Debug, PartialEq)]
struct Frame<'a> {
    servo: u8,
    opcode: u8,
    payload: &'a [u8],
    length: usize,
}

/// Finds a request at the front of the received bytes.
fn scan(bytes: &[u8]) -> Scan<Frame<'_>> {
    match bytes {
        [] | [0xA5] | [0xA5, _] | [0xA5, _, _] => Scan::More,
        [0xA5, servo, opcode, length, rest @ ..] => {
            let n = usize::from(*length);
            let (Some(payload), Some(check)) = (rest.get(..n), rest.get(n)) else { return Scan::More };
            if checksum(bytes.iter().take(4 + n)) != *check {
                return Scan::Skip(1);
            }
            Scan::Take(n + 5, Frame { servo: *servo, opcode: *opcode, payload, length: n + 5 })
        }
        _ => Scan::Skip(1),
    }
}

fn reply(out: &mut Vec<u8>, servo: u8, error: u8, data: &[u8]) {
    let begin = out.len();
    out.extend([0x5A, servo, error, data.len() as u8]);
    out.extend(data);
    let check = checksum(out.iter().skip(begin));
    out.push(check);
}

fn put_state(out: &mut Vec<u8>, servo: u8, error: u8, flags: (bool, bool), position: u16, velocity: i16, goal: u16) {
    let mut data = vec![u8::from(flags.0) + 2 * u8::from(flags.1)];
    [position, velocity as u16, goal].iter().for_each(|word| data.extend([(word >> 8) as u8, *word as u8]));
    reply(out, servo, error, &data);
}

fn checksum<'a>(bytes: impl Iterator<Item = &'a u8>) -> u8 {
    (bytes.map(|byte| u32::from(*byte)).sum::<u32>() & 0xFF) as u8
}

#[cfg(test)]
mod tests {
    use super::super::golden::{self, bytes};
    use super::*;

    #[test]
    fn requests_are_read_from_the_golden_bytes() {
        for (golden, servo, opcode, payload) in [
            (golden::HELLO, 3, 0x01, &[][..]),
            (golden::STATE, 0, 0x02, &[]),
            (golden::MOTORS, 0, 0x03, &[1]),
            (golden::GOAL, 3, 0x04, &[8, 0, 0, 0]),
            (golden::CLEAR, 0, 0x05, &[]),
        ] {
            let frame = bytes(golden);
            let length = frame.len();
            assert_eq!(scan(&frame), Scan::Take(length, Frame { servo, opcode, payload, length }));
            assert_eq!(scan(&frame[..length - 1]), Scan::More);
        }
        let frame = golden::goals();
        assert!(matches!(scan(&frame), Scan::Take(_, Frame { opcode: 4, payload, .. }) if payload.len() == 4 * SERVOS));
    }

    #[test]
    fn replies_are_the_golden_bytes() {
        let mut out = Vec::new();
        reply(&mut out, 3, 0, &[0, 1, 2, 3]);
        assert_eq!(out, bytes(golden::HELLO_REPLY));
        out.clear();
        put_state(&mut out, 2, 1, (true, true), 2048, -100, 2000);
        assert_eq!(out, bytes(golden::STATE_REPLY));
    }
}
