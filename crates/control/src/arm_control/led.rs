//! An arm that is led: by hand, or by its own controller. It gets no setpoints; the limiters follow what is measured,
//! so that the next start is where the arm is.

use super::ArmControl;
use crate::rest::Relief;
use dimos_core::clock::Mono;
use dimos_core::telemetry::{Cause, LedBy, Outcome, Phase};

impl ArmControl {
    /// The arm will be led. It must be at rest; its own controller may only start from within its range.
    pub fn lead(&mut self, by: LedBy, arm: u16, now: Mono) -> Outcome {
        if self.failsafe.phase() == Phase::Ready && !self.at_standstill() {
            return Outcome::ArmMoving(arm);
        }
        if by == LedBy::Controller
            && let Some((joint, _, excess)) = self.out_of_range()
        {
            return Outcome::OutOfLimits((self.first + joint) as u16, excess);
        }
        let outcome = self.failsafe.lead(by, arm, self.feedback.state(), self.feedback.freshness(), now);
        if outcome == Outcome::Accepted {
            self.command.mode = None;
            self.command.lead_seq = self.command.lead_seq.wrapping_add(1);
            self.rest.forget_written();
            self.command.rest = None;
            self.too_fast_since = None;
        }
        outcome
    }

    /// Refuses motion from now on. A led arm gets a stop from its own controller, unless its motors are off.
    pub fn prepare_disable(&mut self, now: Mono) {
        let led = self.failsafe.led_by().is_some_and(|by| by != LedBy::HandMotorsOff);
        self.failsafe.prepare_disable(now);
        self.rest.stop_pending |= led;
    }

    /// Ends the motion of an arm's own controller by its own stop. Returns whether there was one.
    pub fn end_native(&mut self, now: Mono) -> bool {
        let native = self.failsafe.led_by() == Some(LedBy::Controller);
        if native {
            self.prepare_disable(now);
        }
        native
    }

    /// Orders another stop for an arm that is held and gets no setpoints: something may move it.
    pub fn stop_again(&mut self) {
        let held = self.failsafe.phase() == Phase::Held && !self.failsafe.cause().is_foreign();
        // No relief after an operator's stop.
        if held && self.rest.relief != Relief::None {
            (self.rest.relief, self.command.mode) = (Relief::None, None);
        }
        // Whatever the readings say, setpoints at rest are not waited for.
        self.rest.moved &= !held;
        self.rest.stop_pending |= held && self.command.mode.is_none();
    }

    /// Takes the limiters to where the joints are.
    pub(super) fn follow_measured(&mut self) {
        self.command.mode = None;
        for (limiter, q) in self.limiters.iter_mut().zip(&self.feedback.state().position) {
            limiter.seed(*q);
        }
    }

    /// Returns the cause for a hold if the arm's controller moves a joint too fast or out of its range. A hand may do
    /// both.
    pub(super) fn led_trouble(&mut self) -> Option<Cause> {
        if self.failsafe.led_by() != Some(LedBy::Controller) || !self.feedback.is_usable() {
            return None;
        }
        if let Some((joint, position, _)) = self.out_of_range() {
            return Some(Cause::LedOutOfRange(joint as u16, position));
        }
        self.too_fast().map(|(joint, velocity)| Cause::LedTooFast(joint, velocity))
    }

    /// Returns the first joint outside its range, its position, and how far outside it is [rad].
    fn out_of_range(&self) -> Option<(usize, f64, f64)> {
        let limits = &self.config.limits;
        let range = limits.position_lower.iter().zip(&limits.position_upper);
        { self.feedback.state().position.iter().zip(range).enumerate() }.find_map(|(joint, (q, (lower, upper)))| {
            let excess = (lower - q).max(q - upper);
            (excess > self.config.supervision.accuracy).then_some((joint, *q, excess))
        })
    }
}
