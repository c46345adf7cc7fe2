//! `joystick`: follows joint velocities from a stick, on arms that are commanded in positions. It ramps the speed,
//! ignores a stick that rests near its centre, and stops at the ends of the joints' ranges.

use dimos::clock::Mono;
use dimos::control::task_body::{Claim, Context, Demand, OnCancel, Step, Target, TargetKind, TaskBody};
use dimos::control::task_spec::{ParamsSpec, TaskSpec};
use dimos::joint::Joints;
use dimos::telemetry::{Outcome, Reason, TaskState};
use dimos::yaml::range::{non_negative, positive};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The row of the table.
pub const SPEC: TaskSpec = TaskSpec {
    name: "joystick",
    about: "follows the velocities of a stick, in positions",
    params: ParamsSpec::of::<JoystickParams>(),
    takes: &[TargetKind::Velocities],
    demand: Demand::Positions,
    robot: false,
    build: |setup| Ok(Box::new(Joystick::new(setup.params()?))),
};

/// Parameters of a `joystick` task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct JoystickParams {
    /// Without a new target for this long the joints decelerate to rest, and the task ends [s].
    #[serde(deserialize_with = "positive")]
    #[schemars(extend("exclusiveMinimum" = 0.0))]
    pub timeout: f64,
    /// Slower targets count as zero [rad/s].
    #[serde(deserialize_with = "non_negative")]
    #[schemars(range(min = 0.0))]
    pub dead_band: f64,
    /// Highest acceleration; at most the joint's own limit [rad/s²].
    #[serde(deserialize_with = "positive")]
    #[schemars(extend("exclusiveMinimum" = 0.0))]
    pub acceleration: f64,
}

impl Default for JoystickParams {
    fn default() -> Self {
        Self { timeout: 0.2, dead_band: 0.02, acceleration: 1.0 }
    }
}

/// State of a joystick task.
#[derive(Debug)]
struct Joystick {
    params: JoystickParams,
    /// The latest target [rad/s], and when it came.
    target: Joints,
    at: Mono,
    /// What is commanded: [rad], and the speed of it [rad/s].
    position: Joints,
    velocity: Joints,
    cancelled: bool,
}

impl Joystick {
    fn new(params: JoystickParams) -> Self {
        let zero = Joints::default();
        Self { params, target: zero, at: Mono::ZERO, position: zero, velocity: zero, cancelled: false }
    }

    /// Begins at the last command, as fast as that moves.
    fn rebase(&mut self, cx: &Context<'_>) {
        for ((q, v), &joint) in self.position.iter_mut().zip(&mut self.velocity).zip(cx.joints) {
            let view = cx.joint(joint);
            (*q, *v) = (view.commanded, view.commanded_velocity);
        }
    }
}

impl TaskBody for Joystick {
    fn accept(&mut self, cx: &Context<'_>, target: &Target<'_>) -> Result<(), Outcome> {
        let Target::Velocities(velocities) = target else { return Err(Outcome::WrongTask(cx.task)) };
        (self.target, self.at, self.cancelled) = (*velocities, cx.now, false);
        Ok(())
    }

    fn compute(&mut self, cx: &Context<'_>, claims: &mut Vec<Claim>) -> Step {
        let timed_out = cx.now.seconds_since(self.at) > self.params.timeout;
        let stopping = self.cancelled || timed_out;
        // Not granted: nothing of the last tick went out, so nothing moves on its behalf yet.
        let at_rest = !cx.granted || self.velocity.iter().take(cx.joints.len()).all(|v| *v == 0.0);
        if stopping && at_rest {
            return match self.cancelled {
                true => Step::End(TaskState::Aborted, Reason::Cancelled),
                false => Step::End(TaskState::Idle, Reason::Timeout),
            };
        }
        if !cx.granted {
            self.rebase(cx);
        }
        let state = self.position.iter_mut().zip(&mut self.velocity);
        for (((q, v), target), &joint) in state.zip(&self.target).zip(cx.joints) {
            let view = cx.joint(joint);
            let resting = stopping || target.abs() < self.params.dead_band;
            let wanted = if resting { 0.0 } else { within(*target, cx.pace * view.velocity_limit) };
            let most = self.params.acceleration.min(view.acceleration) * cx.dt;
            *v += within(wanted - *v, most);
            let next = *q + *v * cx.dt;
            *q = next.max(view.lower).min(view.upper);
            if *q != next {
                *v = 0.0;
            }
            claims.push(Claim { joint, value: *q });
        }
        Step::Continue
    }

    fn end(&mut self) {
        (self.target, self.cancelled) = (Joints::default(), false);
    }

    fn applies_speed(&self) -> bool {
        true
    }

    fn cancel(&mut self) -> OnCancel {
        self.cancelled = true;
        OnCancel::Decelerate
    }
}

/// The value between `-most` and `most`. Unlike `clamp` it cannot panic.
fn within(value: f64, most: f64) -> f64 {
    value.max(-most).min(most)
}
