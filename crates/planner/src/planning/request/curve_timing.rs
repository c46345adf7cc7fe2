//! The motion along the legs of a request of which some are curves: each in its own time, or, where waypoints are
//! passed at a distance, all in one.

use super::legs::{Leg, passed};
use super::pipeline::{PlanRequest, Stage};
use super::start_contact::{EscapePath, passes};
use crate::collision::Stop;
use crate::planning::curve::fit::{dense, fit};
use crate::planning::curve::join::{joined, rounded};
use crate::planning::curve::joint_curve::JointCurve;
use crate::planning::curve::motion::{after, along};
use crate::planning::curve::settings::CurveSettings;
use crate::planning::search::level::Level;
use crate::planning::search::path::length;
use crate::planning::timing::tool_timing::Tools;
use crate::planning::timing::{free_throughout, time_within};
use dimos_core::joint::JointBounds;
use dimos_core::trajectory::JointTrajectory;

/// A leg shorter than this is no motion [rad].
const NO_MOTION: f64 = 1e-9;

/// Returns the motion along legs; `None` if all are made of straight lines and none is to be refined, or the motion
/// along a curve is not free: the motion along the straight pieces between its configurations may be.
pub(in crate::planning) fn along_curves(
    stage: &mut Stage<'_>,
    legs: &[Leg],
    (bounds, tools): (&[JointBounds], &mut Tools),
    (escape_path, request): (Option<&EscapePath>, &PlanRequest),
    stop: &Stop,
) -> Option<JointTrajectory> {
    let legs: Vec<&Leg> = legs.iter().filter(|leg| length(&leg.path) > NO_MOTION).collect();
    let is_curved = legs.iter().any(|leg| leg.curve.is_some());
    let refined = request.refine >= stage.settings.curve.refine_rounds;
    if !is_curved && (!refined || legs.len() > 1 && request.blend > 0.0) {
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
            Some(curve) => motion(stage, curve, bounds, tools)
                .filter(|motion| is_free(stage, motion, (escape_path, request), stop))?,
            None => along_lines(stage, leg, (bounds, tools), (escape_path, request), refined, stop)?,
        };
        whole = Some(match whole {
            Some(before) => after(before, own),
            None => own,
        });
    }
    whole
}

/// Returns the motion along straight lines whose corners are rounded; if it is to be refined, the quickest of several
/// that stay as close to the lines.
fn along_lines(
    stage: &mut Stage<'_>,
    leg: &Leg,
    (bounds, tools): (&[JointBounds], &mut Tools),
    (escape_path, request): (Option<&EscapePath>, &PlanRequest),
    refined: bool,
    stop: &Stop,
) -> Option<JointTrajectory> {
    let deviation = vec![leg.deviation; leg.path.len()];
    let checker = &mut stage.checker;
    let free = |a: &[f64], b: &[f64]| passes(checker, request.level, escape_path, (a, b), stop);
    let timed = time_within(&stage.joints, &leg.path, bounds, &deviation, &stage.settings.timing, free).ok()?;
    let slowed = tools.slowed(&timed.trajectory, bounds, 1.0, &stage.settings.tool);
    let mut best = slowed.unwrap_or(timed.trajectory);
    if !refined {
        return Some(best);
    }
    let CurveSettings { join, fit: fitting, .. } = &stage.settings.curve;
    let dense = dense(&leg.path, join.fit_spacing);
    // A joint's share of the deviation, which is that of all joints together.
    let share = leg.deviation / (stage.joints.len() as f64).sqrt();
    let fitted = join.fit_shares.iter().filter_map(|part| fit(&dense, part * share, fitting));
    for curve in rounded(&leg.path, &deviation, join).into_iter().chain(fitted).collect::<Vec<_>>() {
        let quicker = motion(stage, &curve, bounds, tools).filter(|motion| motion.duration() < best.duration());
        if let Some(quicker) = quicker.filter(|motion| is_free(stage, motion, (escape_path, request), stop)) {
            best = quicker;
        }
    }
    Some(best)
}

fn motion(stage: &Stage<'_>, curve: &JointCurve, bounds: &[JointBounds], tools: &mut Tools) -> Option<JointTrajectory> {
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
    // Lines and given paths are proven at every level.
    let level = if request.level.proves() { request.level } else { Level::Certified };
    let mut free = |a: &[f64], b: &[f64]| passes(checker, level, escape_path, (a, b), stop);
    free_throughout(motion, &mut free).is_ok()
}
