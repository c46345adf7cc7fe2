//! The controller's check of the points that a program gives to servoj. What they are on a real one:
//!
//! - C204A1, "sudden change in target position": a point farther away than the fastest joint moves in a step.
//! - C204A3, "sudden stop": users report it for motions that end at speed, and for trajectories whose accelerations are
//!   beyond the arm's. The threshold is not published. Here it is a change of velocity within a step that no arm makes,
//!   at 20 rad/s², within the lookahead time over which the controller smooths the points.

use crate::ur::DOF;
use dimos_hardware::sim::arm::SimArm;

/// A point this far from the one before is a jump [rad/s].
const JUMP: f64 = 20.0;
/// Acceleration of which no arm is capable, over the lookahead time [rad/s²].
const SUDDEN: f64 = 20.0;
/// Code of both errors.
const INVALID: u16 = 204;

/// The last point of servoj, and the velocity to it.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Points {
    last: Option<[f64; DOF]>,
    velocity: [f64; DOF],
    /// Argument of the error of the last point that was refused.
    pub argument: i32,
}

impl Points {
    /// Returns the last point.
    pub fn last(&self) -> Option<[f64; DOF]> {
        self.last
    }

    /// Takes a point, `step` [s] after the last one; an invalid one is a protective stop.
    pub fn take(&mut self, arm: &mut SimArm, goal: &[f64; DOF], step: f64, lookahead: f64) {
        let from = self.last.unwrap_or_else(|| super::programs::joints(arm));
        let mut velocity = *goal;
        velocity.iter_mut().zip(from).for_each(|(v, from)| *v = (*v - from) / step);
        let change = velocity.iter().zip(&self.velocity).map(|(now, before)| (now - before).abs()).fold(0.0, f64::max);
        let jumps = velocity.iter().any(|v| v.abs() > JUMP);
        if jumps || change > SUDDEN * lookahead {
            self.argument = if jumps { 1 } else { 3 };
            arm.fail(INVALID);
            return;
        }
        (self.last, self.velocity) = (Some(*goal), velocity);
    }
}
