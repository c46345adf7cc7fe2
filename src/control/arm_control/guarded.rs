//! What the collision guard needs of an arm: its next step, and its deceleration instead of that.

use super::ArmControl;
use crate::control::guard::JointStep;
use crate::joint::ControlMode;

impl ArmControl {
    /// Returns whether its position is known: some state was read.
    pub fn is_placed(&self) -> bool {
        self.feedback.state().seq > 0
    }

    /// Returns whether its commands were at rest before this tick.
    pub fn was_at_rest(&self) -> bool {
        self.before.iter().all(super::Limiter::at_rest)
    }

    /// Returns the step of a joint of the arm in this tick, or with `braking` the first step of its deceleration
    /// instead.
    pub fn step(&self, joint: usize, braking: bool, dt: f64) -> JointStep {
        let measured = self.feedback.state().position.get(joint).copied().unwrap_or_default();
        let (Some(mode), Some(before), Some(limiter)) =
            (self.command.mode, self.before.get(joint), self.limiters.get(joint))
        else {
            return JointStep::at(measured);
        };
        let decrease = limiter.bounds().acceleration * dt;
        let velocity = if braking { before.braked(dt) } else { limiter.velocity() };
        if mode == ControlMode::Velocity {
            let (low, high) =
                self.ahead(dt).and_then(|ahead| ahead.get(joint).copied()).unwrap_or((measured, measured));
            let from = 0.5 * (low + high);
            return JointStep { from, to: from + velocity * dt, velocity, decrease, spread: 0.5 * (high - low) };
        }
        let from = before.position();
        let to = if braking { from + velocity * dt } else { limiter.position() };
        JointStep { from, to, velocity, decrease, spread: 0.0 }
    }

    /// Decelerates instead of following the requests of this tick.
    pub fn brake(&mut self, dt: f64) {
        let velocity = self.command.mode == Some(ControlMode::Velocity);
        let joints = self.limiters.iter_mut().zip(&self.before).zip(&self.feedback.state().position);
        for (((limiter, before), measured), out) in joints.zip(self.command.values.iter_mut()) {
            *out = limiter.brake_from(before, velocity.then_some(*measured), dt);
        }
    }
}
