//! `compliant`: follows joint positions as a spring does. Stiff joints are exact; soft ones yield to a hand or to a
//! workpiece, and press against it with an effort. For arms with impedance mode.

use dimos::clock::Mono;
use dimos::control::task_body::{Claim, Compliance, Context, Demand, Step, Target, TargetKind, TaskBody};
use dimos::control::task_spec::{BuildError, ParamsSpec, TaskSetup, TaskSpec};
use dimos::joint::Joints;
use dimos::telemetry::{Outcome, Reason, TaskState};
use dimos::yaml::range::{non_negative, positive};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The row of the table.
pub const SPEC: TaskSpec = TaskSpec {
    name: "compliant",
    about: "follows positions, and yields as a spring does",
    params: ParamsSpec::of::<CompliantParams>(),
    takes: &[TargetKind::Positions],
    demand: Demand::Impedance,
    robot: false,
    build: |setup| Ok(Box::new(Compliant::new(setup)?)),
};

/// Parameters of a `compliant` task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct CompliantParams {
    /// Stiffness of its joints [Nm/rad].
    #[serde(deserialize_with = "non_negative")]
    #[schemars(range(min = 0.0))]
    pub stiffness: f64,
    /// Damping of its joints [Nm·s/rad].
    #[serde(deserialize_with = "non_negative")]
    #[schemars(range(min = 0.0))]
    pub damping: f64,
    /// Efforts with which they press, one for each [Nm]; empty: none.
    pub effort: Vec<f64>,
    /// Highest speed of its targets; at most the joint's own [rad/s].
    #[serde(deserialize_with = "positive")]
    #[schemars(extend("exclusiveMinimum" = 0.0))]
    pub speed: f64,
    /// Without a new target for this long the task ends, and the arm holds [s].
    #[serde(deserialize_with = "positive")]
    #[schemars(extend("exclusiveMinimum" = 0.0))]
    pub timeout: f64,
}

impl Default for CompliantParams {
    fn default() -> Self {
        Self { stiffness: 60.0, damping: 6.0, effort: Vec::new(), speed: 0.5, timeout: 1.0 }
    }
}

/// State of a compliant task.
#[derive(Debug)]
struct Compliant {
    params: CompliantParams,
    /// Its joints, and the effort of each [Nm].
    efforts: Vec<(u16, f64)>,
    /// The latest target [rad], and when it came.
    target: Joints,
    at: Mono,
    /// What is commanded [rad].
    position: Joints,
}

impl Compliant {
    fn new(setup: &TaskSetup<'_>) -> Result<Self, BuildError> {
        let params: CompliantParams = setup.params()?;
        if !params.effort.is_empty() && params.effort.len() != setup.joints.len() {
            let what = format!("{} efforts for {} joints", params.effort.len(), setup.joints.len());
            return Err(BuildError::new("effort", what).hint("give one for each joint of the task"));
        }
        let effort = params.effort.iter().copied().chain(std::iter::repeat(0.0));
        let efforts = setup.joints.iter().copied().zip(effort).collect();
        Ok(Self { params, efforts, target: Joints::default(), at: Mono::ZERO, position: Joints::default() })
    }
}

impl TaskBody for Compliant {
    fn accept(&mut self, cx: &Context<'_>, target: &Target<'_>) -> Result<(), Outcome> {
        let Target::Positions(positions) = target else { return Err(Outcome::WrongTask(cx.task)) };
        (self.target, self.at) = (*positions, cx.now);
        Ok(())
    }

    fn compute(&mut self, cx: &Context<'_>, claims: &mut Vec<Claim>) -> Step {
        if cx.now.seconds_since(self.at) > self.params.timeout {
            return Step::End(TaskState::Idle, Reason::Timeout);
        }
        for ((q, target), &joint) in self.position.iter_mut().zip(&self.target).zip(cx.joints) {
            let view = cx.joint(joint);
            if !cx.granted {
                *q = view.commanded;
            }
            let step = cx.pace * self.params.speed.min(view.velocity_limit) * cx.dt;
            *q += (target - *q).max(-step).min(step);
            claims.push(Claim { joint, value: *q });
        }
        Step::Continue
    }

    fn compliance(&self, joint: u16) -> Compliance {
        let effort = self.efforts.iter().find(|(own, _)| *own == joint).map_or(0.0, |(_, effort)| *effort);
        let CompliantParams { stiffness, damping, .. } = self.params;
        Compliance { stiffness: Some(stiffness), damping: Some(damping), effort }
    }

    fn end(&mut self) {}

    fn applies_speed(&self) -> bool {
        true
    }
}
