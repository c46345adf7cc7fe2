//! Acts at places of a motion's path.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::api::{ArmIoSet, GoGripper, GoStep, MIN_SPEED};

/// Maximum number of acts.
const MAX_ACTS: usize = 32;

/// Something that is done while an arm moves: at one place of its path, within a tick of when that is commanded.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct OnPath {
    /// Index of the step `plan` whose motion it belongs to, from 0.
    #[serde(default, skip_serializing_if = "is_first")]
    pub step: usize,
    /// Distance that the tool centre point has covered [m]. One of `distance` and `waypoint` is given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub distance: Option<f64>,
    /// Number of the waypoint of `through`, from 1, that is passed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub waypoint: Option<usize>,
    /// Commands a gripper; its outcome is not awaited. One of `gripper`, `output` and `speed` is given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gripper: Option<GoGripper>,
    /// Sets outputs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub output: Option<ArmIoSet>,
    /// Fraction of the speed of all motions, 0.01–1, until the end of this one; never above what it was before, and
    /// not if somebody else has changed it meanwhile.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub speed: Option<f64>,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde asks")]
fn is_first(step: &usize) -> bool {
    *step == 0
}

/// Checks acts against the steps of their request.
pub(crate) fn valid(acts: &[OnPath], steps: &[GoStep], replan: bool) -> Result<(), String> {
    if acts.len() > MAX_ACTS {
        return Err(format!("on_path has {} acts, may have {MAX_ACTS}", acts.len()));
    }
    if replan && !acts.is_empty() {
        return Err("acts on a path belong to one path: leave out `replan` or `on_path`".into());
    }
    acts.iter().enumerate().try_for_each(|(index, act)| {
        let wrong = |what: &str| Err(format!("on_path[{index}]: {what}"));
        let Some(GoStep::Plan(plan)) = steps.get(act.step) else { return wrong("its step is no `plan`") };
        match (act.distance, act.waypoint) {
            (Some(distance), None) if distance >= 0.0 && distance.is_finite() => {}
            (Some(_), None) => return wrong("distance must be 0 or more [m]"),
            (None, Some(waypoint)) if (1..=plan.through.len()).contains(&waypoint) => {}
            (None, Some(_)) => return wrong(&format!("waypoint must be 1 to {}, as in `through`", plan.through.len())),
            _ => return wrong("needs one of distance, waypoint"),
        }
        match (&act.gripper, &act.output, act.speed) {
            (Some(gripper), None, None) if gripper.objects.is_some() => {
                wrong("objects are attached when the arm rests")
            }
            (Some(_), None, None) | (None, Some(_), None) => Ok(()),
            (None, None, Some(speed)) if (MIN_SPEED..=1.0).contains(&speed) => Ok(()),
            (None, None, Some(speed)) => wrong(&format!("speed is {speed}, must be within {MIN_SPEED}–1")),
            _ => wrong("needs one of gripper, output, speed"),
        }
    })
}
