//! A given path in joint space: the motion follows it as it is, and is refused where it is not free.

use super::legs::{Leg, SearchOptions, leg};
use super::pipeline::{Goal, PlanFailure, Stage, StageTimes, failure_for, late};
use crate::collision::{CollisionChecker, Stop};
use crate::planning::curve::fit::fit;
use crate::planning::scene::padded::Near;
use crate::planning::search::path::{Path, between, unwind_all};
use crate::planning::search::path_planner::PlanError;

/// Configurations checked on a line that is not free, to find what blocks it.
const BLOCK_SAMPLES: u32 = 100;

/// A path to follow.
#[derive(Debug, Clone, PartialEq)]
pub struct JointPath {
    /// Configurations [rad], joined by straight lines.
    pub points: Path,
    /// How far the motion may pass from them [rad].
    pub tolerance: f64,
}

/// A position outside its limits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outside {
    /// Index of the point.
    pub point: usize,
    /// Index of the joint.
    pub joint: usize,
    /// Its position [rad].
    pub position: f64,
    /// Its limits [rad].
    pub limits: [f64; 2],
}

impl JointPath {
    /// Moves positions that are outside their joint's limits [rad] by at most the tolerance to the limit.
    pub fn clamp(&mut self, limits: &[[f64; 2]]) -> Result<(), Outside> {
        for (point, q) in self.points.iter_mut().enumerate() {
            for (joint, (position, limits)) in q.iter_mut().zip(limits).enumerate() {
                let inside = position.max(limits[0]).min(limits[1]);
                if (inside - *position).abs() > self.tolerance {
                    return Err(Outside { point, joint, position: *position, limits: *limits });
                }
                *position = inside;
            }
        }
        Ok(())
    }
}

/// Plans the approach to a path of the only moving robot, and the way along it.
pub(in crate::planning) fn legs_along(
    stage: &mut Stage<'_>,
    (robot, path): (usize, &JointPath),
    search: SearchOptions,
    stop: &Stop,
    times: &mut StageTimes,
) -> Result<[Leg; 2], PlanFailure> {
    let mut path = path.clone();
    unwind_all(&mut path.points, &stage.start, stage.checker.turns());
    let limits: Vec<[f64; 2]> = stage.limits.iter().map(|l| [l.lower, l.upper]).collect();
    path.clamp(&limits).map_err(|Outside { joint, position, limits: [lower, upper], .. }| {
        failure_for(stage, &PlanError::Outside { which: "path", joint, position, lower, upper })
    })?;
    let first = path.points.first().cloned().unwrap_or_default();
    let approach = leg(stage, &[(robot, Goal::Joints(first))], search, stop, times)
        .map_err(|failure| PlanFailure { what: format!("the approach to the path: {}", failure.what), ..failure })?;
    unwind_all(&mut path.points, approach.path.last().unwrap_or(&stage.start), stage.checker.turns());
    if let Some(last) = path.points.last() {
        stage.checker.relax(Near::Goal, last);
    }
    let checker = &mut stage.checker;
    for (i, pair) in path.points.windows(2).enumerate() {
        let [a, b] = pair else { continue };
        if checker.motion_is_free(a, b, stop) {
            continue;
        }
        if let Some(failure) = late(stop) {
            return Err(failure);
        }
        let mut q = a.clone();
        let contact = (0..=BLOCK_SAMPLES).find_map(|k| {
            between(a, b, f64::from(k) / f64::from(BLOCK_SAMPLES), &mut q);
            checker.contacts(&q).into_iter().next()
        });
        let what = contact.map_or_else(|| "too close to something".to_owned(), |contact| contact.to_string());
        let (to, of, padding) = (i + 2, path.points.len(), checker.padding());
        let what = format!("the path is not free at its waypoint {to} of {of}: {what} (padding {padding:.4} m)");
        return Err(PlanFailure::new(what).hint("a path is followed as it is: correct the world, or lead it elsewhere"));
    }
    let curve = fit(&path.points, path.tolerance, &stage.settings.curve.fit);
    let curve = curve.filter(|curve| curve.stays_inside(&limits));
    let way = Leg { path: path.points, fraction: None, clamped: Vec::new(), deviation: path.tolerance, curve };
    Ok([approach, way])
}
