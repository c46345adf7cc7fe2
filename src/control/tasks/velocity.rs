//! Follows a stream of joint velocities. When the stream stops, the joints slow down to zero.

use crate::clock::Mono;
use crate::control::config::VelocityParams;
use crate::control::task::{Claim, Context};
use crate::joint::{Joints, MAX_DOF};

/// State of a velocity task.
#[derive(Debug)]
pub struct VelocityTask {
    params: VelocityParams,
    target: Option<(Joints, Mono)>,
    timed_out: bool,
    muted: [bool; MAX_DOF],
}

impl VelocityTask {
    /// A task without a target.
    pub fn new(params: VelocityParams) -> Self {
        Self { params, target: None, timed_out: false, muted: [false; MAX_DOF] }
    }

    /// A new target [rad/s], in the order of the task's joints.
    pub fn set_target(&mut self, cx: &Context<'_>, target: &Joints) {
        self.muted = [false; MAX_DOF];
        self.timed_out = false;
        self.target = Some((*target, cx.now));
    }

    /// Forgets the target.
    pub fn drop_target(&mut self) {
        self.target = None;
        self.timed_out = false;
    }

    /// Whether the stream has stopped and the joints are kept at zero.
    pub fn timed_out(&self) -> bool {
        self.timed_out
    }

    /// A joint is lost until the next target.
    pub fn mute(&mut self, joints: &[u16], joint: u16) {
        if let Some(m) = joints.iter().position(|&j| j == joint).and_then(|k| self.muted.get_mut(k)) {
            *m = true;
        }
    }

    /// Fills in the claims of this tick; `false` when the stream has stopped and the joints are let go.
    pub fn compute(&mut self, cx: &Context<'_>, joints: &[u16], claims: &mut Vec<Claim>) -> bool {
        let Some((target, at)) = &self.target else { return false };
        if self.params.timeout > 0.0 && cx.now.seconds_since(*at) > self.params.timeout {
            self.timed_out = true;
            if !self.params.zero_on_timeout {
                return false;
            }
        }
        for ((&joint, &value), muted) in joints.iter().zip(target).zip(&self.muted) {
            if !muted {
                claims.push(Claim { joint, value: if self.timed_out { 0.0 } else { value } });
            }
        }
        true
    }
}
