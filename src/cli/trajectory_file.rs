//! Reads a trajectory from JSON or CSV; mistakes are reported with file, line and column.

use std::fmt::Display;
use std::fs::File;
use std::io::Read;
use std::path::Path;

use serde_json::Value;

use super::exit::{Failure, Result};
use dimos_core::trajectory::MAX_DURATION;
use dimos_rpc::api::{Point, Trajectory};

/// Maximum file size [bytes].
const MAX_FILE: u64 = 16 << 20;
/// Suffix of a CSV column of velocities.
const VELOCITY: &str = "_vel";

/// Reads a file; its extension decides the format.
pub fn read(path: &Path) -> Result<Trajectory> {
    let unreadable = |what: &dyn Display| Failure::usage(format!("{}: {what}", path.display()));
    let mut text = String::new();
    let file = File::open(path).map_err(|e| unreadable(&e))?;
    let read = file.take(MAX_FILE + 1).read_to_string(&mut text).map_err(|e| unreadable(&e))?;
    if read as u64 > MAX_FILE {
        return Err(unreadable(&"larger than 16 MiB"));
    }
    // What some editors and spreadsheets write first: a mark of the encoding.
    let text = text.trim_start_matches('\u{feff}');
    let parsed = match path.extension().and_then(|e| e.to_str()) {
        Some("json") => json(text),
        Some("csv") => csv(text),
        _ => return Err(unreadable(&"neither .json nor .csv").hint("the extension decides the format")),
    };
    let mut trajectory = parsed.map_err(|e| unreadable_at(path, &e))?;
    // An empty list is none.
    for point in &mut trajectory.points {
        let given = |list: Option<Vec<f64>>| list.filter(|list| !list.is_empty());
        (point.velocities, point.accelerations) = (given(point.velocities.take()), given(point.accelerations.take()));
    }
    if trajectory.points.len() < 2 {
        return Err(unreadable(&"a trajectory needs at least two points"));
    }
    Ok(trajectory)
}

/// A mistake and its position; lines and columns count from 1.
#[derive(Debug, PartialEq)]
struct Mistake {
    line: usize,
    column: usize,
    what: String,
}

fn unreadable_at(path: &Path, mistake: &Mistake) -> Failure {
    Failure::usage(format!("{}:{}:{}: {}", path.display(), mistake.line, mistake.column, mistake.what))
        .hint("`dimos execute --help` shows both formats")
}

fn json(text: &str) -> std::result::Result<Trajectory, Mistake> {
    serde_json::from_str(text).or_else(|e| as_of_ros(text).ok_or(e)).map_err(|e| {
        let what = e.to_string();
        // The position is in front already.
        let what = what.rsplit_once(" at line ").map_or(what.as_str(), |(what, _)| what).to_owned();
        Mistake { line: e.line(), column: e.column(), what }
    })
}

/// Reads the form of the ROS message: with a header, times as seconds and nanoseconds, and empty lists for what is not
/// given. `None` if it is not that either.
fn as_of_ros(text: &str) -> Option<Trajectory> {
    let mut value: Value = serde_json::from_str(text).ok()?;
    let trajectory = value.as_object_mut()?;
    trajectory.remove("header");
    for point in trajectory.get_mut("points")?.as_array_mut()? {
        let point = point.as_object_mut()?;
        point.retain(|_, value| value.as_array().is_none_or(|list| !list.is_empty()));
        if let Some(time) = point.get_mut("time_from_start").filter(|time| time.is_object()) {
            let part = |key: &str| time.get(key).map_or(Some(0.0), Value::as_f64);
            *time = (part("sec")? + part("nanosec")? * 1e-9).into();
        }
    }
    serde_json::from_value(value).ok()
}

fn csv(text: &str) -> std::result::Result<Trajectory, Mistake> {
    // What spreadsheets write: with semicolons between cells a comma is the decimal point.
    let heading = text.lines().find(|line| !line.trim().is_empty()).unwrap_or_default();
    let semicolons = heading.contains(';') && !heading.contains(',');
    let text = if semicolons { text.replace(',', ".").replace(';', ",") } else { text.to_owned() };
    let mut lines = text.lines().enumerate().map(|(i, text)| (i + 1, text)).filter(|(_, t)| !t.trim().is_empty());
    let Some((line, header)) = lines.next() else {
        return Err(Mistake { line: 1, column: 1, what: "the file is empty".into() });
    };
    let header = Header::read(line, header)?;
    let mut points = Vec::new();
    for (line, text) in lines {
        let mut values = Vec::new();
        for (column, cell) in cells(text) {
            match cell.parse::<f64>() {
                Ok(value) if value.is_finite() => values.push(value),
                _ => return Err(Mistake { line, column, what: format!("{cell:?} is not a finite number") }),
            }
        }
        if values.len() != header.width {
            let what = format!("{} values for {} columns", values.len(), header.width);
            return Err(Mistake { line, column: 1, what });
        }
        if let Some(time) = values.first().filter(|time| **time > MAX_DURATION) {
            let what = format!("{time} s exceeds the maximum duration of {} h", MAX_DURATION / 3600.0);
            return Err(Mistake { line, column: 1, what });
        }
        let pick = |columns: &[usize]| columns.iter().filter_map(|c| values.get(*c).copied()).collect::<Vec<_>>();
        points.push(Point {
            time_from_start: values.first().copied().unwrap_or_default(),
            positions: pick(&header.positions),
            velocities: (!header.velocities.is_empty()).then(|| pick(&header.velocities)),
            accelerations: None,
        });
    }
    Ok(Trajectory { joint_names: header.joints, points })
}

/// Columns of a file.
struct Header {
    joints: Vec<String>,
    positions: Vec<usize>,
    /// In the order of the joints; empty or complete.
    velocities: Vec<usize>,
    width: usize,
}

impl Header {
    fn read(line: usize, text: &str) -> std::result::Result<Self, Mistake> {
        let names: Vec<(usize, &str)> = cells(text).collect();
        let mistake = |column, what| Err(Mistake { line, column, what });
        if names.first().map(|(_, name)| *name) != Some("time") {
            return mistake(1, "the first column must be `time` [s]".into());
        }
        for (index, (column, name)) in names.iter().enumerate() {
            if name.is_empty() || names.iter().take(index).any(|(_, other)| other == name) {
                return mistake(*column, format!("the column {name:?} has no name or is a duplicate"));
            }
        }
        let of = |name: &str| names.iter().position(|(_, n)| *n == name);
        // `x_vel` is a velocity if there is a joint `x`; otherwise it is a joint's name.
        let is_velocity = |name: &str| name.strip_suffix(VELOCITY).is_some_and(|joint| of(joint).is_some());
        let (mut joints, mut positions, mut velocities) = (Vec::new(), Vec::new(), Vec::new());
        for (index, (_, name)) in names.iter().enumerate().skip(1).filter(|(_, (_, name))| !is_velocity(name)) {
            joints.push((*name).to_owned());
            positions.push(index);
            velocities.extend(of(&format!("{name}{VELOCITY}")));
        }
        if joints.is_empty() {
            return mistake(1, "no joint columns besides `time`".into());
        }
        if !velocities.is_empty() && velocities.len() != joints.len() {
            return mistake(1, format!("velocities of {} of {} joints: all or none", velocities.len(), joints.len()));
        }
        Ok(Self { joints, positions, velocities, width: names.len() })
    }
}

/// Returns the cells of a line, each with its column in the text.
fn cells(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let mut start = 1;
    text.split(',').map(move |cell| {
        let column = start + cell.chars().take_while(|c| c.is_whitespace()).count();
        start += cell.chars().count() + 1;
        (column, cell.trim())
    })
}
