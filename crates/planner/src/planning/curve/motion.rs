//! Trajectories along curves.

use super::clock::quickest;
use super::joint_curve::JointCurve;
use super::settings::ClockSettings;
use crate::planning::timing::trajectory_of;
use dimos_core::joint::JointBounds;
use dimos_core::trajectory::JointTrajectory;

/// Returns the quickest trajectory along a curve, from rest to rest, as [`quickest`] finds it.
pub fn along(
    names: &[String],
    curve: &JointCurve,
    bounds: &[JointBounds],
    tool: impl FnMut(&[f64], &[f64]) -> f64,
    settings: &ClockSettings,
) -> Option<JointTrajectory> {
    let (states, _) = quickest(curve, bounds, tool, settings)?;
    trajectory_of(names, &states, true).ok()
}

/// Returns a motion from rest to rest after another.
pub fn after(mut first: JointTrajectory, second: JointTrajectory) -> JointTrajectory {
    let start = first.duration();
    let mut points = second.points.into_iter();
    if let (Some(last), Some(begin)) = (first.points.last_mut(), points.next()) {
        // Without accelerations the piece that follows would be another one.
        last.accelerations = begin.accelerations;
    }
    first.points.extend(points.map(|mut point| {
        point.time_from_start += start;
        point
    }));
    first
}
