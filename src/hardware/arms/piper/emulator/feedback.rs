//! Frames that the controller sends in every period.

use super::super::protocol::DOF;
use super::controller::{Controller, first, millidegrees};
use super::kinematics::Links;
use super::wire::{self, Status};
use crate::hardware::sim::arm::SimArm;
use crate::hardware::sim::faults::FaultKind;
use crate::hardware::sim::reach::Chain;
use crate::hardware::transport::can::CanFrame;
use crate::pose;

/// Torque per current [Nm/A] of joints 1–3 and 4–6, and what firmware up to 1.8-2 leaves of the former's currents.
const TORQUE: [f64; 2] = [1.18125, 0.95844];
const QUARTER: f64 = 0.25;

impl Controller {
    /// What is sent in the period that begins now; the slow frames come with every fifth.
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
        let status = Status {
            control: self.control,
            arm: self.arm.error().min(255) as u8,
            mode: self.mode,
            teach: u8::from(self.teaching),
            moving: self.arm.moving(),
            limits: self.beyond,
        };
        out.push(status.frame());
        let (xyz, rpy) = pose::to_xyz_rpy(&Links.forward(&positions));
        let ([x, y, z], [roll, pitch, yaw]) = (xyz.map(|v| (v * 1e6).round() as i32), rpy.map(millidegrees));
        out.extend(wire::triple(0x2A2, [x, y, z, roll, pitch, yaw]));
        out.extend(wire::triple(0x2A5, positions.map(millidegrees)));
        if self.has_gripper {
            let on = if self.gripper_on { 0x40 } else { 0 };
            let torque = if self.gripper_on { (self.gripper.force() * 1e3).round() as i16 } else { 0 };
            out.push(wire::gripper(stroke, torque, 0x80 | on | self.gripper_errors)); // it knows its zero
        }
        let efforts = first(&self.arm.efforts());
        let milli = |value: f64| (value * 1e3).round() as i32;
        for (((joint, velocity), effort), position) in (1..).zip(velocities).zip(efforts).zip(positions) {
            let (torque, part) = if joint <= 3 { (TORQUE[0], self.part()) } else { (TORQUE[1], 1.0) };
            out.push(wire::motor(joint, milli(velocity), milli(effort / torque * part), milli(position)));
        }
        if self.ticks.is_multiple_of(5) {
            for joint in 1..=DOF as u16 {
                let (on, celsius) =
                    (self.arm.motor(usize::from(joint - 1)), SimArm::temperature((joint - 1).into()) as i8);
                out.push(wire::driver(joint, 240, [celsius, 30], if on { 0x40 } else { 0 }, if on { 400 } else { 20 }));
            }
        }
        if let Some(muted) = &self.muted {
            out.retain(|frame| !muted.contains(&frame.id));
        }
    }

    /// What this firmware reports of the currents of joints 1 to 3.
    fn part(&self) -> f64 {
        if self.firmware.as_slice() <= b"S-V1.8-2".as_slice() { QUARTER } else { 1.0 }
    }
}
