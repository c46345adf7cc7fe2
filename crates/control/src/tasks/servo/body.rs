//! Follows a stream of joint positions. If targets arrive less often than the tick, commands are interpolated linearly
//! over the period of the stream, so that a slow stream gives a smooth motion. A target that no joint can reach in its
//! time is refused, and the stream continues; when such targets have come for a while, the arm is held. When the stream
//! stops, the joints decelerate to rest.

use super::params::ServoParams;
use crate::config::JUMP;
use crate::task_body::{Claim, Context, OnLoss, Step, Target, TaskBody};
use dimos_core::clock::Mono;
use dimos_core::joint::{Joints, MAX_DOF, joints_of};
use dimos_core::telemetry::{Outcome, Reason, TaskState};

/// Maximum period of a stream; a longer pause starts a new one [s].
const LONGEST_PERIOD: f64 = 0.1;
/// A step between two targets may take this much of the joint's velocity limit.
const REACH: f64 = 1.5;
/// A teleoperated arm's stream has single wrong targets. After this time of nothing else the arm is held [s].
const WRONG_FOR: f64 = 0.2;

/// State of a servo task.
#[derive(Debug)]
pub struct ServoTask {
    params: ServoParams,
    target: Option<Setpoint>,
    /// The first of the targets that were refused since then.
    wrong_since: Option<Mono>,
    /// Joints lost to a task of higher priority, until the next target.
    muted: [bool; MAX_DOF],
}

#[derive(Debug, Clone, Copy)]
struct Setpoint {
    from: Joints,
    to: Joints,
    at: Mono,
    /// Time between two targets of the stream [s]; 0 until it is known.
    period: f64,
}

impl Setpoint {
    fn reached(&self, cx: &Context<'_>) -> Joints {
        // The first step is made in the tick of the target. The interpolation takes a tick longer than the period of
        // the stream, so that a target which is a tick late causes no halt.
        let done = if self.period > 1.5 * cx.dt {
            ((cx.now.seconds_since(self.at) + cx.dt) / (self.period + cx.dt)).clamp(0.0, 1.0)
        } else {
            1.0
        };
        let mut out = self.to;
        if done < 1.0 {
            for (o, from) in out.iter_mut().zip(&self.from) {
                *o = from + (*o - from) * done;
            }
        }
        out
    }
}

impl ServoTask {
    /// Creates a task without a target.
    pub fn new(params: ServoParams) -> Self {
        Self { params, target: None, wrong_since: None, muted: [false; MAX_DOF] }
    }

    /// Returns the first joint that cannot be at its target in the time since the last one, and its step [rad].
    fn out_of_reach(&self, cx: &Context<'_>, to: &Joints) -> Option<(u16, f64)> {
        let last = self.target.as_ref()?;
        let pause = cx.now.seconds_since(last.at);
        cx.joints.iter().zip(to).zip(&last.to).find_map(|((&joint, to), last)| {
            let step = to - last;
            let most = JUMP.max(cx.joint(joint).velocity_limit * pause * REACH);
            (step.is_nan() || step.abs() > most).then_some((joint, step))
        })
    }

    /// Sets a new target [rad], in the order of the task's joints.
    fn set_target(&mut self, cx: &Context<'_>, to: &Joints) {
        self.muted = [false; MAX_DOF];
        let (from, period) = match &self.target {
            None => (*to, 0.0),
            Some(last) => {
                let pause = cx.now.seconds_since(last.at);
                let period = match last.period {
                    _ if pause > LONGEST_PERIOD => 0.0,
                    p if p > 0.0 => p + 0.25 * (pause - p),
                    _ => pause,
                };
                let before = Context { now: cx.now.before(std::time::Duration::from_secs_f64(cx.dt)), ..*cx };
                let from = last.reached(&before);
                // After lost targets the way may be long: it takes the time that the joints need.
                let time = |(k, &joint): (usize, &u16)| {
                    let way = to.get(k).zip(from.get(k)).map_or(0.0, |(to, from)| (to - from).abs());
                    if way > JUMP { way / cx.joint(joint).velocity_limit } else { 0.0 }
                };
                let needed = cx.joints.iter().enumerate().map(time).fold(0.0, f64::max);
                (from, period.max(needed))
            }
        };
        self.target = Some(Setpoint { from, to: *to, at: cx.now, period });
    }
}

impl TaskBody for ServoTask {
    fn accept(&mut self, cx: &Context<'_>, target: &Target<'_>) -> Result<(), Outcome> {
        let Target::Positions(positions) = target else { return Err(Outcome::WrongTask(cx.task)) };
        if !cx.active {
            // A stream begins at the arm's position.
            for (&joint, value) in cx.joints.iter().zip(positions) {
                let step = value - cx.joint(joint).commanded;
                if step.abs() > JUMP {
                    return Err(Outcome::StartStateMismatch(joint, step.abs()));
                }
            }
        }
        if let Some((joint, step)) = self.out_of_reach(cx, positions).filter(|_| cx.active) {
            let since = *self.wrong_since.get_or_insert(cx.now);
            if cx.now.seconds_since(since) < WRONG_FOR {
                return Err(Outcome::OutOfReach(joint, step));
            }
            // It is requested as it is: a jump holds the arm.
            self.target = None;
        }
        self.wrong_since = None;
        self.set_target(cx, positions);
        Ok(())
    }

    fn compute(&mut self, cx: &Context<'_>, claims: &mut Vec<Claim>) -> Step {
        let age = |target: &Setpoint| cx.now.seconds_since(target.at);
        let fresh = |target: &&Setpoint| self.params.timeout <= 0.0 || age(target) <= self.params.timeout;
        let Some(target) = self.target.as_ref().filter(fresh) else {
            return Step::End(TaskState::Idle, Reason::Timeout);
        };
        let values = target.reached(cx);
        for ((&joint, &value), muted) in cx.joints.iter().zip(&values).zip(&self.muted) {
            if !muted {
                claims.push(Claim { joint, value });
            }
        }
        Step::Continue
    }

    fn end(&mut self) {
        (self.target, self.wrong_since) = (None, None);
    }

    fn lose(&mut self, joints: &[u16], joint: u16) -> OnLoss {
        if let Some(m) = joints.iter().position(|&j| j == joint).and_then(|k| self.muted.get_mut(k)) {
            *m = true;
        }
        OnLoss::Continue
    }

    fn first_target(&self) -> Option<Target<'static>> {
        self.params.default_positions.as_deref().map(|positions| Target::Positions(joints_of(positions)))
    }
}
