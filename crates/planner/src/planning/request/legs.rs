//! The legs of a motion: one to each waypoint, and one to the goals.

use std::time::Instant;

use super::goals;
use super::joint_path::legs_along;
use super::pipeline::{Goal, PlanFailure, PlanRequest, Stage, StageTimes, bounds_of, failure_for};
use super::settings::BlendSettings;
use crate::collision::{CollisionChecker, Stop};
use crate::planning::curve::fit::{dense, fit};
use crate::planning::curve::joint_curve::JointCurve;
use crate::planning::curve::settings::CurveSettings;
use crate::planning::scene::padded::Near;
use crate::planning::search::level::Level;
use crate::planning::search::path::{Path, distance, unwind};
use crate::planning::search::path_planner::plan;
use crate::planning::search::settings::PlanSettings;

/// How a way is searched.
#[derive(Debug, Clone, Copy)]
pub(in crate::planning) struct SearchOptions {
    pub seed: u64,
    pub level: Level,
    pub refine: u32,
}

/// The way to one goal.
pub(in crate::planning) struct Leg {
    pub path: Path,
    /// The part of a straight line that was followed.
    pub fraction: Option<f64>,
    /// Joints of its goal that were moved to their limits: name, requested and used position [rad or m].
    pub clamped: Vec<(String, f64, f64)>,
    /// Maximum deviation at its corners [rad].
    pub deviation: f64,
    /// The smooth curve along it, if it is not made of straight lines.
    pub curve: Option<JointCurve>,
}

/// Plans the way through all waypoints to the goals.
pub(in crate::planning) fn legs(
    stage: &mut Stage<'_>,
    request: &PlanRequest,
    stop: &Stop,
    times: &mut StageTimes,
) -> Result<Vec<Leg>, PlanFailure> {
    let begin = stage.start.clone();
    let PlanRequest { seed, level, refine, .. } = *request;
    let search = SearchOptions { seed, level, refine };
    let mut legs: Vec<Leg> = Vec::new();
    for (i, goals) in request.through.iter().chain([&request.goals]).enumerate() {
        if let Some(at) = legs.last().and_then(|leg| leg.path.last()) {
            stage.start.clone_from(at);
        }
        if let [(robot, Goal::Path(path))] = goals.as_slice() {
            legs.extend(legs_along(stage, (*robot, path), search, stop, times)?);
            continue;
        }
        let found = leg(stage, goals, search, stop, times).map_err(|failure| match request.through.is_empty() {
            true => failure,
            false => PlanFailure { what: format!("waypoint {}: {}", i + 1, failure.what), ..failure },
        });
        legs.push(found?);
    }
    stage.start = begin;
    Ok(legs)
}

/// Plans the way from the stage's start to goals.
pub(in crate::planning) fn leg(
    stage: &mut Stage<'_>,
    goals: &[(usize, Goal)],
    search: SearchOptions,
    stop: &Stop,
    times: &mut StageTimes,
) -> Result<Leg, PlanFailure> {
    let began = Instant::now();
    let mut took = |name: &str, time: f64| *times.entry(name.to_owned()).or_default() += time;
    match goals {
        [(_, Goal::Line(_) | Goal::Arc { .. })] => {
            let (path, fraction, curve) = goals::line(stage, &goals[0].1, stop)?;
            took("search", began.elapsed().as_secs_f64());
            let deviation = stage.settings.blend.line_deviation;
            Ok(Leg { path, fraction: Some(fraction), deviation, clamped: Vec::new(), curve })
        }
        [(_, Goal::Retrace(given))] => {
            let path = goals::follow(stage, given, stop)?;
            took("search", began.elapsed().as_secs_f64());
            let deviation = stage.settings.blend.line_deviation;
            let CurveSettings { fit: fitting, join, .. } = &stage.settings.curve;
            let curve = fit(&dense(&path, join.fit_spacing), deviation, fitting);
            Ok(Leg { path, fraction: None, clamped: Vec::new(), deviation, curve })
        }
        several if several.iter().any(|(_, goal)| matches!(goal, Goal::Retrace(_))) => {
            Err(PlanFailure::new("a given path is for one robot at a time"))
        }
        several if several.iter().any(|(_, goal)| matches!(goal, Goal::Line(_) | Goal::Arc { .. } | Goal::Path(_))) => {
            Err(PlanFailure::new("a straight line or a path is planned for one robot at a time"))
        }
        wanted => {
            let goals = goals::configurations(stage, wanted, search.seed, stop)?;
            for goal in &goals {
                let mut goal = goal.clone();
                unwind(&mut goal, &stage.start, stage.checker.turns());
                stage.checker.relax(Near::Goal, &goal);
            }
            took("ik", began.elapsed().as_secs_f64());
            let SearchOptions { seed, level, refine } = search;
            let settings = PlanSettings { seed, level, refine, ..stage.settings.plan };
            let start = stage.start.clone();
            let found =
                plan(&mut stage.checker, &start, &goals, &settings, stop).map_err(|e| failure_for(stage, &e))?;
            took("search", found.search_time.as_secs_f64());
            took("shorten", found.shorten_time.as_secs_f64());
            let choosing = Instant::now();
            let refined = found.refine_time;
            let (path, clamped) = match bounds_of(stage) {
                Ok(bounds) => {
                    let Stage { joints, checker, .. } = stage;
                    found.quickest(joints, &bounds, &stage.settings.timing, |a, b| checker.motion_looks_free(a, b))
                }
                Err(_) => (found.path, found.clamped),
            };
            if refine > 0 {
                took("refine", (refined + choosing.elapsed()).as_secs_f64());
            }
            let used = |joint: usize| Some((stage.joints.get(joint)?.clone(), *path.last()?.get(joint)?));
            let moved = clamped.iter().filter_map(|(joint, asked)| Some((*asked, used(*joint)?)));
            let clamped = moved.map(|(asked, (joint, used))| (joint, asked, used)).collect();
            Ok(Leg { path, fraction: None, clamped, deviation: stage.settings.timing.deviation, curve: None })
        }
    }
}

/// Joins the legs to one path, with the maximum deviation at each of its configurations [rad]. At a waypoint it is that
/// at which an end effector passes at the distance `blend` [m].
pub(in crate::planning) fn joined(stage: &Stage<'_>, legs: &[Leg], blend: f64) -> (Path, Vec<f64>) {
    let (mut path, mut deviation) = (Path::new(), Vec::new());
    for leg in legs {
        if let ([.., before, at], Some(after)) = (path.as_slice(), leg.path.get(1)) {
            let passes = waypoint_deviation(stage, before, at, after, blend);
            deviation.pop();
            deviation.push(passes);
        }
        let skip = usize::from(!path.is_empty());
        path.extend(leg.path.iter().skip(skip).cloned());
        deviation.resize(path.len(), leg.deviation);
    }
    (path, deviation)
}

/// Returns the deviation [rad] at a corner at which no end effector passes farther away than `blend` [m].
fn waypoint_deviation(stage: &Stage<'_>, before: &[f64], at: &[f64], after: &[f64], blend: f64) -> f64 {
    let (to, from) = (distance(before, at).max(1e-12), distance(at, after).max(1e-12));
    let turn: Vec<f64> = before.iter().zip(at).zip(after).map(|((a, b), c)| (c - b) / from - (b - a) / to).collect();
    let size = turn.iter().map(|t| t * t).sum::<f64>().sqrt();
    let BlendSettings { max_deviation, min_piece, .. } = stage.settings.blend;
    if blend <= 0.0 || size < 1e-9 || to.min(from) < min_piece {
        return 0.0;
    }
    let farthest = |deviation: f64| {
        let blended: Vec<f64> = at.iter().zip(&turn).map(|(q, t)| q + t / size * deviation).collect();
        passed(stage, at, &blended)
    };
    let mut deviation = max_deviation;
    for _ in 0..6 {
        let distance = farthest(deviation);
        if distance <= blend {
            break;
        }
        deviation *= 0.99 * blend / distance;
    }
    deviation
}

/// Returns the largest distance of an end effector between two configurations [m].
pub(in crate::planning) fn passed(stage: &Stage<'_>, a: &[f64], b: &[f64]) -> f64 {
    let (mut first, mut most) = (0, 0.0_f64);
    for robot in &stage.robots {
        let own = first..first + robot.joints.len();
        first = own.end;
        let place = |q: &[f64]| robot.tcp_pose(q.get(own.clone()).unwrap_or_default()).translation;
        most = most.max(place(a).distance(place(b)));
    }
    most
}
