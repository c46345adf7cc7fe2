//! The emulator: plays the arm on a bus in memory or on a CAN interface, for `address: sim` and for tests.
//!
//! It has its own reading of the sheet in `protocol.rs` and shares no code with it: an emulator that shared the adapter's
//! encoders would share its mistakes. YOUR ARM: change it as you change `protocol.rs`. What the arm itself does, its
//! joints, motors, errors and faults, is in `SimArm`.

use std::time::Duration;

use dimos_hardware::adapter::AdapterResult;
use dimos_hardware::clock::{Clock, Mono, MonotonicClock};
use dimos_hardware::joint::ControlMode;
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos_hardware::sim::arm::{Delivery, HasArm, Refusal, SimArm};
use dimos_hardware::sim::can_server::{CanController, CanServer, PLAYABLE};
use dimos_hardware::transport::can::CanFrame;

use super::{DOF, NATIVE_RATE, Options, limits};

/// Starts an emulator at `place`, with the `sim` part of the arm's options. It ends when it is dropped.
pub fn start(config: &AdapterConfig, place: &EmulatorAddress) -> AdapterResult<Box<dyn Emulator>> {
    let options: Options = config.options()?;
    let arm = SimArm::new("acme", &limits(), &options.sim, PLAYABLE, MonotonicClock.now())?;
    let controller = AcmeController { arm, speed: 100, targets: [0; DOF] };
    Ok(Box::new(CanServer::start("acme", controller, place, Duration::from_secs_f64(1.0 / NATIVE_RATE))?))
}

/// The arm's computer: commands in, what the arm makes of them, its state out.
struct AcmeController {
    arm: SimArm,
    /// Of planned moves [%].
    speed: u8,
    /// [0.001 deg]
    targets: [i32; DOF],
}

impl HasArm for AcmeController {
    fn arm(&mut self) -> &mut SimArm {
        &mut self.arm
    }
}

impl CanController for AcmeController {
    /// What the arm refuses it ignores, as arms on CAN do.
    fn on_frame(&mut self, frame: &CanFrame, now: Mono, answers: &mut Vec<CanFrame>) {
        self.arm.advance(now);
        if self.arm.loses_command() {
            return;
        }
        let _refusal = match (frame.id, frame.bytes()) {
            (0x150, [1, on, ..]) => self.arm.enable(*on != 0),
            (0x150, [2, mode @ 0..=1, speed @ 1..=100, ..]) => {
                self.speed = *speed;
                self.arm.set_mode(if *mode == 0 { ControlMode::Position } else { ControlMode::ServoPosition })
            }
            (0x150, [3, ..]) => self.arm.clear_error(),
            (0x150, [4, ..]) => {
                self.arm.stop();
                Ok(())
            }
            (0x150, [5, ..]) => {
                self.arm.client_came();
                answers.push(identity(self.arm.claimed_dof() as u8));
                Ok(())
            }
            (0x160..=0x16F, &[a, b, c, d, e, f, g, h]) => {
                let first = 2 * (frame.id - 0x160) as usize;
                let pair = [u32::from_be_bytes([a, b, c, d]) as i32, u32::from_be_bytes([e, f, g, h]) as i32];
                self.targets.iter_mut().skip(first).zip(pair).for_each(|(to, value)| *to = value);
                if first + 2 >= DOF { self.go() } else { Ok(()) }
            }
            _ => Ok(()),
        };
    }

    fn tick(&mut self, now: Mono, frames: &mut Vec<CanFrame>) -> Delivery {
        self.arm.advance(now);
        let measured = self.arm.measured();
        put_joints(frames, 0x2A0, &measured.positions.map(thousandths));
        put_joints(frames, 0x2B0, &measured.velocities.map(thousandths));
        let mode = if self.arm.mode() == ControlMode::Position { 0 } else { 1 };
        frames.push(status(self.arm.enabled(), self.arm.moving(), mode, self.arm.error()));
        self.arm.delivery()
    }
}

impl AcmeController {
    /// All targets have come.
    fn go(&mut self) -> Result<(), Refusal> {
        let target = self.targets.map(|value| (f64::from(value) * 0.001).to_radians());
        if self.arm.mode() == ControlMode::Position {
            self.arm.move_to(&target, f64::from(self.speed) / 100.0)
        } else {
            self.arm.servo(&target)
        }
    }
}

// --- Bytes ---

/// [rad] as [0.001 deg].
fn thousandths(value: f64) -> i32 {
    (value * 180_000.0 / std::f64::consts::PI).round() as i32
}

/// Frames from `id` on, two joints in each.
fn put_joints(out: &mut Vec<CanFrame>, id: u16, values: &[i32]) {
    let values = values.get(..DOF).unwrap_or_default();
    for (pair, id) in values.chunks(2).zip(id..) {
        let mut data = [0; 8];
        let bytes = pair.iter().flat_map(|value| [24, 16, 8, 0].map(|shift| (value >> shift) as u8));
        data.iter_mut().zip(bytes).for_each(|(to, byte)| *to = byte);
        out.push(CanFrame::new(id, &data));
    }
}

fn status(enabled: bool, moving: bool, mode: u8, error: u16) -> CanFrame {
    let flags = u8::from(enabled) + 2 * u8::from(moving);
    CanFrame::new(0x2C0, &[flags, mode, (error >> 8) as u8, error as u8, 0, 0, 0, 0])
}

fn identity(dof: u8) -> CanFrame {
    CanFrame::new(0x2D0, &[1, dof, 2, 1, 0, 0, 0, 42])
}

#[cfg(test)]
mod tests {
    use super::super::golden::{self, JOINTS, frame};
    use super::*;
    use dimos_hardware::sim::arm::SimOptions;

    #[test]
    fn feedback_is_the_golden_bytes() {
        let mut frames = Vec::new();
        put_joints(&mut frames, 0x2A0, &JOINTS.map(|(value, _)| value));
        assert_eq!(frames, golden::of_joints(0x2A0));
        assert_eq!(status(true, true, 1, 2), frame(golden::STATUS));
        assert_eq!(identity(6), frame(golden::IDENTITY));
        assert_eq!(thousandths(-20.0_f64.to_radians()), -20_000);
    }

    #[test]
    fn the_golden_commands_are_obeyed() {
        let now = Mono(1_000_000_000);
        let arm = SimArm::new("acme", &limits(), &SimOptions::default(), PLAYABLE, now).unwrap();
        let mut controller = AcmeController { arm, speed: 100, targets: [0; DOF] };
        let mut answers = Vec::new();
        let mut hear = |frame: &CanFrame, after: u64| {
            controller.on_frame(frame, now.after(Duration::from_millis(after)), &mut answers);
            (controller.arm.enabled(), controller.arm.mode(), controller.arm.moving(), controller.speed)
        };
        assert_eq!(hear(&frame(golden::ENABLE), 0), (true, ControlMode::Position, false, 100));
        assert_eq!(hear(&frame(golden::MODE), 1), (true, ControlMode::ServoPosition, false, 25));
        for joints in golden::of_joints(0x160) {
            hear(&joints, 2);
        }
        assert!(hear(&frame(golden::CLEAR), 50).2, "it moves");
        hear(&frame(golden::STOP), 60);
        assert!(!hear(&frame(golden::IDENTIFY), 2000).2, "it is at rest");
        assert_eq!(controller.targets[..], JOINTS.map(|(value, _)| value)[..DOF]);
        assert_eq!(answers, [identity(DOF as u8)]);
    }
}
