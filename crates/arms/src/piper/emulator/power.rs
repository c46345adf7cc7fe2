//! The controller's motors: switching on and off, faults, and the motion of the joints over time.

use std::time::Duration;

use super::super::protocol::DOF;
use super::controller::{Controller, state};
use dimos_core::clock::Mono;
use dimos_hardware::registry::Truth;
use dimos_hardware::sim::arm::{HasArm, SimArm};
use dimos_hardware::sim::faults::FaultKind;

/// Speed at which the arm falls when its motors go off [rad/s], and the joint positions at which it rests. Before the
/// motors are on for the first time the arm is supported.
const FALL: f64 = 0.3;
const FOLDED: [Option<f64>; DOF] = [None, Some(0.0), Some(0.0), None, Some(0.0), None];
/// How long the motors take to come on, one after the other.
const MOTOR_START: Duration = Duration::from_millis(40);
const NEXT_MOTOR: Duration = Duration::from_millis(5);

impl Controller {
    /// Everything is off, and starts again when the power is back.
    pub(super) fn lose_power(&mut self) {
        (self.control, self.mode, self.speed, self.follow, self.beyond) = (0, 0, 0, 0, 0);
        self.teaching = false;
        self.arm.restart();
        self.arm.release_estop();
        self.motors_off();
    }

    pub(super) fn estop(&mut self) {
        self.arm.press_estop();
        self.motors_off();
    }

    pub(super) fn motors_off(&mut self) {
        self.starting = None;
        self.gripper_on = false;
        self.gripper.stop();
        let _ = self.arm.enable(false);
    }

    /// Lets the motors come on one after the other.
    fn start_motors(&mut self) {
        let Some(since) = self.starting else { return };
        for (joint, nth) in (0..DOF).zip(0..) {
            if self.arm.now() >= since.after(MOTOR_START + NEXT_MOTOR * nth) {
                self.arm.enable_joint(joint, true);
            }
        }
        if self.arm.enabled() {
            self.all_motors_on();
        }
    }

    fn all_motors_on(&mut self) {
        self.starting = None;
        self.arm.falls(FALL, &FOLDED);
        if self.control == 1 {
            self.arm.resume_goal();
        }
    }

    pub(super) fn switch(&mut self, motor: u8, action: u8) {
        match (motor, action) {
            (_, 2) if self.arm.error() == state::ESTOP => {}
            (7 | 255, 2) if !self.arm.enabled() => {
                self.starting.get_or_insert(self.arm.now());
                self.gripper_on = true;
            }
            (7 | 255, 1) => self.motors_off(),
            (1..=6, 1 | 2) => {
                self.arm.enable_joint(usize::from(motor - 1), action == 2);
                if action == 2 && self.arm.enabled() {
                    self.all_motors_on();
                }
            }
            _ => {}
        }
    }
}

impl HasArm for Controller {
    fn arm(&mut self) -> &mut SimArm {
        &mut self.arm
    }

    fn complete(&self, truth: &mut Truth) {
        truth.gripper_position = self.has_gripper.then_some(self.gripper.position);
        truth.gripper_force = self.has_gripper.then_some(self.gripper.max_force);
    }

    /// An E-stop that ends after its duration leaves no error.
    fn advance(&mut self, now: Mono) {
        let (before, open) = (self.arm.now(), self.arm.estop_open());
        self.arm.integrate(now);
        self.gripper.play(|kind| self.arm.take_fault(kind));
        self.gripper.advance(self.arm.now().seconds_since(before));
        if open {
            let _still_open = self.arm.clear_error();
        }
        self.start_motors();
        // Errors of the gripper; what else the arm does not call by a number of its own.
        if let Some(fault) = self.arm.take_fault_if(FaultKind::ErrorCode, |fault| (400..=405).contains(&fault.code)) {
            self.gripper_errors |= 1 << (fault.code - 400);
            self.gripper.stop();
        }
        self.arm.apply_faults();
        if !open && self.arm.estop_open() {
            self.motors_off();
        }
        self.leading |= self.arm.take_fault(FaultKind::Leader).is_some();
    }
}
