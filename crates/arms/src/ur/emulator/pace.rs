//! How fast the controller runs motion: the pendant's slider, times what its trajectory limiter takes off in addition.
//! A point of servoj takes one step of the controller's own time, so that a slowed program waits longer in each call.
//!
//! That servoj is slowed this way is from the vendor's descriptions (at half the speed, the arm makes half of the way
//! to a setpoint in its time); the exact law is not published.

use super::controller::Controller;
use crate::ur::DOF;
use dimos_hardware::sim::arm::Refusal;

/// Rounding of what is left of a step.
const ROUNDING: f64 = 1e-9;

/// The way to the present point of servoj.
#[derive(Debug, Clone, Copy)]
pub(super) struct Segment {
    from: [f64; DOF],
    to: [f64; DOF],
    /// Which part of it has passed, 0 to 1.
    done: f64,
}

impl Controller {
    /// Returns the fraction of its speed at which it runs motion.
    pub(super) fn pace(&self) -> f64 {
        (self.slider * self.scaling).clamp(0.0, 1.0)
    }

    /// Returns what RTDE has as `speed_scaling`: 0 while no program runs.
    pub(super) fn speed_scaling(&self) -> f64 {
        if self.program.is_some() && !self.paused { self.scaling } else { 0.0 }
    }

    /// Runs the program for a step of the controller.
    pub(super) fn step_program(&mut self) {
        let (before, (positions, velocities)) = (self.commanded.0, self.arm.joints());
        let six = |values: dimos_core::joint::Joints| values.first_chunk().copied().unwrap_or_default();
        self.commanded = (six(positions), six(velocities));
        if self.paused || self.hangs || !self.may_move() {
            self.segment = None;
            return;
        }
        let (mut left, mut ends, step) = (self.pace(), false, self.step_time());
        let mut target = None;
        loop {
            if self.segment.is_none() {
                let Some(mut program) = self.program.take() else { break };
                let pace = self.pace();
                ends = program.step(&mut self.arm, &mut self.registers, &mut self.payload, (step, pace), &self.build);
                let goal = program.servoed();
                self.stop_argument = program.argument();
                if let Some(failure) = program.failure() {
                    self.report_exception(1, &failure);
                }
                self.program = Some(program);
                let Some(to) = goal else { break };
                self.servoj.push_back((self.arm.now(), to));
                self.servoj.drain(..self.servoj.len().saturating_sub(super::controller::SERVOJ_KEPT));
                self.segment = Some(Segment { from: target.unwrap_or(before), to, done: 0.0 });
            }
            let Some(segment) = &mut self.segment else { break };
            let passes = left.min(1.0 - segment.done);
            (segment.done, left) = (segment.done + passes, left - passes);
            let Segment { from, to, done } = *segment;
            if done >= 1.0 - ROUNDING {
                (target, self.segment) = (Some(to), None);
            } else {
                target = Some(between(&from, &to, done));
            }
            if ends || left < ROUNDING {
                break;
            }
        }
        if let Some(target) = target
            && self.arm.servo(&target) != Err(Refusal::OutOfRange)
        {
            let mut velocity = target;
            velocity.iter_mut().zip(before).for_each(|(v, before)| *v = (*v - before) / step);
            self.commanded = (target, velocity);
        }
        if ends {
            self.stop_program();
        }
    }
}

/// The point at a part of the way.
fn between(from: &[f64; DOF], to: &[f64; DOF], part: f64) -> [f64; DOF] {
    let mut at = *from;
    at.iter_mut().zip(to).for_each(|(at, to)| *at += (to - *at) * part);
    at
}
