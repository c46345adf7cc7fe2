//! The queue of planned moves, and the supervision of those and of streams.

use std::time::Duration;

use super::controlled_arm::{ControlledArm, Refusal};
use super::controller::{Controller, SERVO, first, state};
use super::judge::{tool_limit, tool_speed};
use super::line::Line;
use super::registers::GUIDED;
use crate::xarm::model::Model;
use dimos_hardware::sim::faults::FaultKind;

/// Most moves in the queue.
pub(super) const QUEUE: usize = 256;
/// A request whose outcome is not known yet is made again within this time.
const REPEATED_WITHIN: Duration = Duration::from_millis(500);

/// What a planned move does.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Goal {
    /// Goes to joints [rad].
    Joints([f64; 7]),
    /// Goes along a line of the tool.
    Line(Line),
    /// Waits.
    Pause(Duration),
}

impl Goal {
    /// Returns the joints [rad] at its end, if it moves them.
    pub fn end(&self) -> Option<[f64; 7]> {
        match self {
            Self::Joints(joints) => Some(*joints),
            Self::Line(line) => line.points().last().copied(),
            Self::Pause(_) => None,
        }
    }
}

/// A planned move.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Move {
    pub goal: Goal,
    /// Highest speed [rad/s] and acceleration [rad/s²] of a joint.
    pub speed: f64,
    /// See `speed`.
    pub acceleration: f64,
}

impl<A: ControlledArm> Controller<A> {
    /// Raises the errors of the box's own supervision.
    pub(super) fn watch(&mut self) {
        let (Some(chain), 0, true) = (self.chain, self.error(), self.arm.is_ready()) else { return };
        let (positions, velocities) = self.arm.joints();
        let (positions, velocities) = (first(&positions), first(&velocities));
        if self.mode == SERVO && self.state == state::STANDING {
            let model = Model::of(&self.identity);
            let (limit, code) = tool_limit(model, self.firmware, self.settings.limit_factor);
            let reduced = self.settings.reduced.active.map(|limits| f64::from(limits.line_speed) / 1000.0);
            let limit = reduced.map_or(limit, |reduced| reduced.min(limit));
            if tool_speed(chain, &self.tool_offset(), &positions, &velocities) > limit {
                return self.fail(code);
            }
        }
        if self.mode != GUIDED
            && let Some(code) = self.outside(&positions, &velocities)
        {
            return self.fail(code);
        }
        let collides = self.settings.sensitivity[0] > 0 && self.arm.lasts(FaultKind::Blocked);
        if let Some(code) = self.judge.blocked(collides, &positions, self.mode, self.arm.now()) {
            self.fail(code);
        }
    }

    /// Returns whether a planned move or a pause is under way.
    pub(super) fn is_busy(&self) -> bool {
        self.arm.moving() || self.pauses_until.is_some()
    }

    /// Begins a planned move.
    pub(super) fn start(&mut self, next: &Move) -> Result<(), Refusal> {
        self.judge.goes_to(next.goal.end());
        match &next.goal {
            Goal::Joints(target) => self.arm.go(&[*target], next.speed, next.acceleration),
            Goal::Line(line) => self.arm.go(line.points(), next.speed, next.acceleration),
            Goal::Pause(time) => {
                self.pauses_until = Some(self.arm.now().after(*time));
                Ok(())
            }
        }
    }

    /// Begins the next planned move when the one before it is done.
    pub(super) fn next_move(&mut self) {
        if self.pauses_until.is_some_and(|until| until <= self.arm.now()) {
            self.pauses_until = None;
        }
        if self.is_busy() {
            return;
        }
        if self.state == state::STOPPING {
            self.state = state::STOPPED;
        }
        if self.state == state::STANDING {
            self.current = None;
            let Some(next) = self.queue.front().cloned() else { return };
            match self.start(&next) {
                Err(Refusal::Pending) => {}
                Err(Refusal::Error(code)) => self.fail(code),
                Ok(()) | Err(Refusal::NotNow | Refusal::Warning(_)) => self.current = self.queue.pop_front(),
            }
        }
    }

    /// Returns the goal that an equal request had a moment ago, which is now repeated.
    pub(super) fn repeated(&mut self, data: &[u8]) -> Option<Goal> {
        let now = self.arm.now();
        let (payload, goal, at) = self.unanswered.as_mut()?;
        if payload != data || now.since(*at) > REPEATED_WITHIN {
            return None;
        }
        *at = now;
        Some(goal.clone())
    }

    /// Keeps the goal of a request until its outcome is known.
    pub(super) fn keep_goal(&mut self, data: &[u8], goal: &Goal) {
        self.unanswered = Some((data.to_vec(), goal.clone(), self.arm.now()));
    }

    /// The outcome is known.
    pub(super) fn forget_goal(&mut self) {
        self.unanswered = None;
    }
}
