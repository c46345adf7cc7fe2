//! Follows a stream of joint velocities. When the stream stops, the joints decelerate to rest.

use super::params::VelocityParams;
use crate::task_body::{Claim, Context, OnLoss, Step, Target, TaskBody};
use dimos_core::clock::Mono;
use dimos_core::joint::{Joints, MAX_DOF};
use dimos_core::telemetry::{Outcome, Reason, TaskState};

/// State of a velocity task.
#[derive(Debug)]
pub struct VelocityTask {
    params: VelocityParams,
    target: Option<(Joints, Mono)>,
    /// Whether the stream has stopped and zero velocity is commanded.
    timed_out: bool,
    /// Joints lost to a task of higher priority, until the next target.
    muted: [bool; MAX_DOF],
}

impl VelocityTask {
    /// Creates a task without a target.
    pub fn new(params: VelocityParams) -> Self {
        Self { params, target: None, timed_out: false, muted: [false; MAX_DOF] }
    }
}

impl TaskBody for VelocityTask {
    fn accept(&mut self, cx: &Context<'_>, target: &Target<'_>) -> Result<(), Outcome> {
        let Target::Velocities(velocities) = target else { return Err(Outcome::WrongTask(cx.task)) };
        self.muted = [false; MAX_DOF];
        self.timed_out = false;
        self.target = Some((*velocities, cx.now));
        Ok(())
    }

    fn compute(&mut self, cx: &Context<'_>, claims: &mut Vec<Claim>) -> Step {
        let Some((target, at)) = &self.target else { return Step::End(TaskState::Idle, Reason::Timeout) };
        if self.params.timeout > 0.0 && cx.now.seconds_since(*at) > self.params.timeout {
            self.timed_out = true;
            if !self.params.zero_on_timeout {
                return Step::End(TaskState::Idle, Reason::Timeout);
            }
        }
        for ((&joint, &value), muted) in cx.joints.iter().zip(target).zip(&self.muted) {
            if !muted {
                claims.push(Claim { joint, value: if self.timed_out { 0.0 } else { value } });
            }
        }
        if self.timed_out { Step::ContinueFor(Reason::Timeout) } else { Step::Continue }
    }

    fn end(&mut self) {
        self.target = None;
        self.timed_out = false;
    }

    fn lose(&mut self, joints: &[u16], joint: u16) -> OnLoss {
        if let Some(m) = joints.iter().position(|&j| j == joint).and_then(|k| self.muted.get_mut(k)) {
            *m = true;
        }
        OnLoss::Continue
    }
}
