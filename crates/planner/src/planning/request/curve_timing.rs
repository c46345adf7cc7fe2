//! The motion along the legs of a request of which some are curves: each in its own time, or, where waypoints are passed
//! at a distance, all in one.

use super::legs::{Leg, passed};
use super::pipeline::{PlanRequest, Stage};
use super::start_contact::{EscapePath, passes};
use crate::collision::Stop;
use crate::planning::curve::join::{joined, rounded};
use crate::planning::curve::joint_curve::JointCurve;
use crate::planning::curve::motion::{after, along};
use crate::planning::search::path::length;
use crate::planning::timing::tool_timing::Tools;
use crate::planning::timing::{free_throughout, time_within};
use dimos_core::joint::JointBounds;
use dimos_core::trajectory::JointTrajectory;

/// A leg shorter than this is no motion [rad].
const NO_MOTION: f64 = 1e-9;

/// Returns the motion along legs; `None` if none of them is a curve, or the motion along it is not free: the motion
/// along the straight pieces between their configurations may be.
pub(in crate::planning) fn along_curves(
    stage: &mut Stage<'_>,
    legs: &[Leg],
    (bounds, tools): (&[JointBounds], &mut Tools),
    (escape_path, request): (Option<&EscapePath>, &PlanRequest),
    stop: &Stop,
) -> Option<JointTrajectory> {
    let legs: Vec<&Leg> = legs.iter().filter(|leg| length(&leg.path) > NO_MOTION).collect();
    if !legs.iter().any(|leg| leg.curve.is_some()) {
        return None;
    }
    let settings = &stage.settings.curve;
    if request.blend > 0.0 && legs.len() > 1 {
        let curve = |leg: &&Leg| match &leg.curve {
            Some(curve) => Some(curve.clone()),
            None => rounded(&leg.path, &vec![leg.deviation; leg.path.len()], &settings.join),
        };
        if let Some(curves) = legs.iter().map(curve).collect::<Option<Vec<_>>>() {
            for part in settings.join.parts {
                let apart = |a: &[f64], b: &[f64]| passed(stage, a, b);
                let whole = joined(&curves, part * request.blend, apart, &settings.join)?;
                let motion = motion(stage, &whole, bounds, tools)?;
                if is_free(stage, &motion, (escape_path, request), stop) {
                    return Some(motion);
                }
            }
        }
    }
    let mut whole: Option<JointTrajectory> = None;
    for leg in legs {
        let own = match &leg.curve {
            Some(curve) => motion(stage, curve, bounds, tools)?,
            None => {
                let deviation = vec![leg.deviation; leg.path.len()];
                let checker = &mut stage.checker;
                let free = |a: &[f64], b: &[f64]| passes(checker, request.level, escape_path, (a, b), stop);
                let timing = &stage.settings.timing;
                let timed = time_within(&stage.joints, &leg.path, bounds, &deviation, timing, free).ok()?;
                tools.slowed(&timed.trajectory, bounds, 1.0, &stage.settings.tool).unwrap_or(timed.trajectory)
            }
        };
        if leg.curve.is_some() && !is_free(stage, &own, (escape_path, request), stop) {
            return None;
        }
        whole = Some(match whole {
            Some(before) => after(before, own),
            None => own,
        });
    }
    whole
}

fn motion(
    stage: &Stage<'_>,
    curve: &JointCurve,
    bounds: &[JointBounds],
    tools: &mut Tools,
) -> Option<JointTrajectory> {
    let part = |q: &[f64], v: &[f64]| tools.part(q, v);
    let motion = along(&stage.joints, curve, bounds, part, &stage.settings.curve.clock)?;
    Some(tools.slowed(&motion, bounds, 1.0, &stage.settings.tool).unwrap_or(motion))
}

fn is_free(
    stage: &mut Stage<'_>,
    motion: &JointTrajectory,
    (escape_path, request): (Option<&EscapePath>, &PlanRequest),
    stop: &Stop,
) -> bool {
    let checker = &mut stage.checker;
    let mut free = |a: &[f64], b: &[f64]| passes(checker, request.level, escape_path, (a, b), stop);
    free_throughout(motion, &mut free).is_ok()
}
