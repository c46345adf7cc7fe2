//! The path of a motion that was led by hand or recorded: from a file to the waypoints of `--path`.

mod logged;
mod steps;

use std::path::Path;

use super::exit::{Failure, Result};
use super::{output, trajectory_file};
use crate::offline::{FitSettings, fit, thin, unwind};
use dimos_log::joints::{Places, twice};
use dimos_rpc::api::{JointPath, MAX_LINE, MAX_PATH};
use dimos_rpc::client::ClientError;
use dimos_rpc::{Code, RpcError};
use steps::{Recording, Steps};

/// Bytes of a request besides its waypoints, at most.
const ENVELOPE: usize = 1024;

/// Returns the joints of an arm among all arms and their joints.
pub fn joints_of(arm: &str, unknown: Code, mut arms: Vec<(String, Vec<String>)>) -> Result<Vec<String>> {
    match arms.iter().position(|(name, _)| name == arm) {
        Some(index) => Ok(arms.swap_remove(index).1),
        None => {
            let names: Vec<&String> = arms.iter().map(|(name, _)| name).collect();
            Err(ClientError::Refused(RpcError::unknown(unknown, "arm", arm, &names)).into())
        }
    }
}

/// Reads the positions of an arm's joints from a trajectory file (.json, .csv) or a log (.mcap), and reduces them to
/// waypoints, so that the motion stays within `tolerance` [rad] of the record. Joints that are continuous (`turns`) may
/// jump by whole turns in it.
pub fn read(file: &Path, joints: &[String], turns: &[bool], tolerance: f64) -> Result<JointPath> {
    let rows = match file.extension().and_then(|e| e.to_str()) {
        Some("mcap") => logged::read(file, joints, turns, tolerance)?,
        _ if file.is_dir() => logged::read(file, joints, turns, tolerance)?,
        _ => written(file, joints, turns)?,
    };
    let points = waypoints(&rows, tolerance);
    let (path, count) = (file.display(), points.len());
    let fits = serde_json::to_string(&points).is_ok_and(|text| text.len() + ENVELOPE <= MAX_LINE);
    if !(2..=MAX_PATH).contains(&count) || !fits {
        let what = format!("{path}: {} positions make {count} waypoints, ", rows.len())
            + &match fits {
                true => format!("must be 2 to {MAX_PATH}"),
                false => format!("more than a request can have ({MAX_LINE} bytes)"),
            };
        return Err(Failure::usage(what).hint("a larger --tolerance makes fewer"));
    }
    output::note(format_args!(
        "{path}: {} positions, followed through {count} waypoints within {tolerance} rad",
        rows.len()
    ));
    Ok(JointPath { points, tolerance: tolerance / 2.0 })
}

/// Returns the fewest positions of a record through which the smooth curve stays within `tolerance` [rad] of it. The
/// run's curve may pass them within half of that.
fn waypoints(rows: &[Vec<f64>], tolerance: f64) -> Vec<Vec<f64>> {
    let mut points = Vec::new();
    for part in [2.0, 4.0, 8.0, 16.0, 32.0, 64.0] {
        points = thin(rows, tolerance / part);
        points.iter_mut().flatten().for_each(|q| *q = rounded(*q));
        let curve = fit(&points, tolerance / 2.0, &FitSettings::default());
        if points.len() == rows.len() || curve.is_none_or(|curve| curve.farthest(rows) <= tolerance) {
            break;
        }
    }
    points
}

/// Returns a position to 1e-7 rad, which is finer than any encoder and half as long in a request.
fn rounded(q: f64) -> f64 {
    (q * 1e7).round() / 1e7
}

/// Reads the positions of joints in a trajectory file, in order of time.
fn written(file: &Path, joints: &[String], turns: &[bool]) -> Result<Vec<Vec<f64>>> {
    let mut trajectory = trajectory_file::read(file)?;
    let path = file.display();
    if let Some(missing) = joints.iter().find(|joint| !trajectory.joint_names.contains(joint)) {
        let failure =
            Failure::usage(format!("{path}: no joint {missing}; it has {}", trajectory.joint_names.join(", ")));
        return Err(failure.hint("joints are matched by name, as `dimos state` shows them"));
    }
    if let Some(joint) = twice(&trajectory.joint_names) {
        let failure = Failure::usage(format!("{path}: joint_names has {joint} twice"));
        return Err(failure.hint("a point has one position per joint name"));
    }
    if !trajectory.points.is_sorted_by_key(|point| point.time_from_start) {
        output::note(format_args!("{path}: the rows were not in order of time"));
        trajectory.points.sort_by(|a, b| a.time_from_start.total_cmp(&b.time_from_start));
    }
    let (mut places, mut rows) = (Places::new(joints), Vec::<Vec<f64>>::new());
    let (mut steps, mut time) = (Steps::new(joints, Recording::File), f64::NEG_INFINITY);
    let ends = trajectory.points.first().zip(trajectory.points.last());
    // Points without times are places to go through.
    let has_times = ends.is_some_and(|(first, last)| first.time_from_start < last.time_from_start);
    for point in &trajectory.points {
        let mut row: Vec<f64> = places.pick(&trajectory.joint_names, &point.positions).collect();
        if row.iter().any(|q| !q.is_finite()) {
            let what = format!("{path}: the point at {} s lacks a position", point.time_from_start);
            return Err(Failure::usage(what).hint("a point has one position per joint name"));
        }
        if let Some(last) = rows.last() {
            unwind(&mut row, last, turns);
            if has_times {
                let checked = steps.check(time, point.time_from_start - time, last, &row);
                checked.map_err(|failure| Failure { what: format!("{path}: {}", failure.what), ..failure })?;
            }
        }
        time = point.time_from_start;
        rows.push(row);
    }
    Ok(rows)
}
