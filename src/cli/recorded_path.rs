//! The path of a motion that was led by hand or recorded: from a file to the waypoints of `--path`.

use std::path::Path;

use super::exit::{Exit, Failure, Result};
use super::{output, trajectory_file};
use crate::planning::thin::thin;
use crate::recording::replay::{LogReader, Payload, ReplayError, Selection};
use crate::rpc::api::{JointPath, MAX_LINE, MAX_PATH};
use crate::rpc::client::ClientError;
use crate::rpc::{Code, RpcError};

/// Bytes of a request besides its waypoints, at most.
const ENVELOPE: usize = 1024;

/// Columns of joint positions [rad], in rows of time.
struct Record {
    joints: Vec<String>,
    rows: Vec<Vec<f64>>,
}

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
/// waypoints, so that the motion stays within `tolerance` [rad] of the record.
pub fn read(file: &Path, joints: &[String], tolerance: f64) -> Result<JointPath> {
    let record = match file.extension().and_then(|e| e.to_str()) {
        Some("mcap") => logged(file).map_err(|e| Failure::of(Exit::Usage, e))?,
        _ => {
            let trajectory = trajectory_file::read(file)?;
            let rows = trajectory.points.into_iter().map(|point| point.positions).collect();
            Record { joints: trajectory.joint_names, rows }
        }
    };
    let column = |joint: &String| record.joints.iter().position(|name| name == joint);
    let missing = joints.iter().find(|joint| column(joint).is_none());
    if let (Some(missing), path) = (missing, file.display()) {
        let failure = Failure::usage(format!("{path}: no joint {missing}; it has {}", record.joints.join(", ")));
        return Err(failure.hint("joints are matched by name, as `dimos state` shows them"));
    }
    let columns: Vec<usize> = joints.iter().filter_map(column).collect();
    let row = |row: &Vec<f64>| columns.iter().map(|c| row.get(*c).copied().filter(|q| q.is_finite())).collect();
    let rows: Vec<Vec<f64>> = record.rows.iter().filter_map(row).collect();
    // Half of the tolerance is for the straight lines, half for the blends between them.
    let points = thin(&rows, tolerance / 2.0);
    let points: Vec<Vec<f64>> = points.iter().map(|row| row.iter().map(|q| rounded(*q)).collect()).collect();
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

/// Returns a position to 1e-7 rad, which is finer than any encoder and half as long in a request.
fn rounded(q: f64) -> f64 {
    (q * 1e7).round() / 1e7
}

/// Reads the joint states of a log.
fn logged(file: &Path) -> std::result::Result<Record, ReplayError> {
    let mut log = LogReader::open(file)?;
    log.select(Selection { topics: vec!["/joint_states".to_owned()], ..Selection::default() })?;
    let mut record = Record { joints: Vec::new(), rows: Vec::new() };
    loop {
        match log.next_entry() {
            Ok(Some(entry)) => {
                let Payload::JointState(state) = entry.data else { continue };
                if record.joints.is_empty() {
                    record.joints = state.name;
                }
                // At rest all rows are the same.
                if state.position.len() == record.joints.len() && record.rows.last() != Some(&state.position) {
                    record.rows.push(state.position);
                }
            }
            // What is before a cut is a path, too.
            Ok(None) | Err(ReplayError::Cut { .. }) => return Ok(record),
            Err(e) => return Err(e),
        }
    }
}
