//! Frames that the controller sends in every period.

use super::super::protocol::DOF;
use super::controller::{Controller, first, millidegrees};
use super::wire::{self, Status};
use dimos_core::pose;
use dimos_hardware::sim::arm::SimArm;
use dimos_hardware::sim::faults::FaultKind;
use dimos_hardware::sim::reach::Chain;
use dimos_hardware::transport::can::CanFrame;

/// Torque per current [Nm/A] of joints 1–3 and 4–6, and what firmware up to 1.8-2 leaves of the former's currents.
const TORQUE: [f64; 2] = [1.18125, 0.95844];
const QUARTER: f64 = 0.25;
/// Joints whose drivers report in each slot of 10 ms: every joint 20 times a second.
const DRIVER_SLOTS: [&[u16]; 5] = [&[4], &[3], &[2], &[1, 6], &[5]];
/// A moving joint shows its last position in 2 of 5 cycles, in no more than two after another, and otherwise its
/// position with this error [rad].
const SHOWN: (f64, u8, f64) = (0.6, 2, 0.0014);
/// Slower than this a joint rests [rad/s].
const MOVING: f64 = 0.005;

/// What a joint shows while it moves: a staircase, as recorded, with steps back.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Staircase {
    shown: f64,
    kept: u8,
}

impl Staircase {
    /// Returns the position that is shown for this one [rad] in a cycle.
    fn show(&mut self, position: f64, velocity: f64, cycle: u64) -> f64 {
        let (share, most, error) = SHOWN;
        if velocity.abs() < MOVING {
            (self.shown, self.kept) = (position, 0);
        } else if scattered(2 * cycle) > share && self.kept < most {
            self.kept += 1;
        } else {
            (self.shown, self.kept) = (position + error * (2.0 * scattered(2 * cycle + 1) - 1.0), 0);
        }
        self.shown
    }
}

/// Returns a number from 0 to 1 that looks random and is always the same (SplitMix64).
fn scattered(n: u64) -> f64 {
    let z = n.wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    let z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
}

impl Controller {
    /// What is sent in the period that begins now. At rest it is, in time and order, what a real arm was recorded with:
    /// joints and pose 200 times a second, motors 100 times, one driver or two in each 10 ms.
    pub(super) fn report(&mut self, out: &mut Vec<CanFrame>) {
        self.ticks += 1;
        let stroke = (self.gripper.position * 1e6).round() as i32;
        let zero = self.arm.take_fault(FaultKind::ZeroState).is_some();
        let (mut positions, mut velocities) = (self.six(), first(&self.arm.joints().1));
        if self.leading {
            return out.extend(wire::leading(positions.map(millidegrees), stroke));
        }
        self.arm.misread(&mut positions, &mut velocities);
        if zero {
            (positions, velocities) = ([0.0; DOF], [0.0; DOF]);
        }
        let cycles = (0..).map(|joint| self.ticks * DOF as u64 + joint);
        for (((position, velocity), joint), cycle) in
            positions.iter_mut().zip(velocities).zip(&mut self.staircases).zip(cycles)
        {
            *position = joint.show(*position, velocity, cycle);
        }
        let status = Status {
            control: self.control,
            arm: self.arm.error().min(255) as u8,
            mode: self.mode,
            teach: u8::from(self.teaching),
            moving: self.arm.moving(),
            limits: self.beyond,
        };
        out.push(status.frame());
        let (xyz, rpy) = pose::to_xyz_rpy(&self.links.forward(&positions));
        let ([x, y, z], [roll, pitch, yaw]) = (xyz.map(|v| (v * 1e6).round() as i32), rpy.map(millidegrees));
        out.extend(wire::triple(0x2A2, [x, y, z, roll, pitch, yaw]));
        out.extend(wire::triple(0x2A5, positions.map(millidegrees)));
        if self.has_gripper {
            let on = if self.gripper_on { 0x40 } else { 0 };
            let torque = if self.gripper_on { (self.gripper.force() * 1e3).round() as i16 } else { 0 };
            out.push(wire::gripper(stroke, torque, on | self.gripper_errors));
        }
        if !self.ticks.is_multiple_of(2) {
            self.report_motors(&positions, &velocities, out);
        }
        if let Some(muted) = &self.muted {
            out.retain(|frame| !muted.contains(&frame.id));
        }
    }

    fn report_motors(&self, positions: &[f64; DOF], velocities: &[f64; DOF], out: &mut Vec<CanFrame>) {
        let efforts = first(&self.arm.efforts());
        let milli = |value: f64| (value * 1e3).round() as i32;
        for (((joint, velocity), effort), position) in (1..).zip(velocities).zip(efforts).zip(positions) {
            let (torque, part) = if joint <= 3 { (TORQUE[0], self.part()) } else { (TORQUE[1], 1.0) };
            out.push(wire::motor(joint, milli(*velocity), milli(effort / torque * part), milli(*position)));
        }
        // At a lower rate than an arm's, for slow readers of the bus, they come together, soon enough to be believed.
        let slot = (self.ticks / 2) as usize % DRIVER_SLOTS.len();
        let joints = match self.slow {
            false => DRIVER_SLOTS.get(slot).copied().unwrap_or_default(),
            true if slot.is_multiple_of(2) => &[1, 2, 3, 4, 5, 6],
            true => &[],
        };
        for joint in joints {
            let (on, celsius) = (self.arm.motor(usize::from(joint - 1)), SimArm::temperature((joint - 1).into()) as i8);
            let (flags, current) = if on { (0x40, 400) } else { (0, 20) };
            out.push(wire::driver(*joint, 240, [celsius, 30], flags, current));
        }
    }

    /// What this firmware reports of the currents of joints 1 to 3.
    fn part(&self) -> f64 {
        if self.firmware.as_slice() <= b"S-V1.8-2".as_slice() { QUARTER } else { 1.0 }
    }
}
