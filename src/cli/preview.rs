//! `dimos preview`: a plan as a table of samples, as a trajectory file, or sampled for a plot.

use std::path::PathBuf;

use anyhow::Context;

use super::arguments::{Target, finite};
use super::escapes::safe;
use super::exit::{Exit, Result};
use super::goal::{Planned, show};
use super::output::{self, Table, fixed, number};
use dimos_rpc::api::{Preview, PreviewReply};
use dimos_rpc::report::TcpReport;

/// Most samples of the motion in the table, and the columns that each takes on the terminal.
const SAMPLES: usize = 8;
const SAMPLE_COLUMNS: usize = 8;

/// Arguments of `preview`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Number of the plan; default: the newest of `dimos plan`
    pub plan: Option<u64>,
    /// Print the motion of joints and tool centre points at this rate, for a plot: CSV, or JSON with --json
    #[arg(long, value_name = "N", value_parser = rate)]
    pub hz: Option<f64>,
    /// Write the trajectory to a JSON file for `dimos execute FILE`
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let reply = args.target_run.connect()?.call(Preview { plan: args.plan, hz: args.hz })?;
    if let Some(file) = &args.out {
        let text = serde_json::to_string(&reply.trajectory).unwrap_or_default();
        std::fs::write(file, text + "\n").with_context(|| file.display().to_string())?;
        output::note(format_args!("written to {}", file.display()));
    }
    if args.target_run.json {
        output::json(&reply);
        return Ok(Exit::Ok);
    }
    if args.hz.is_some() {
        output::data(safe(&csv(&reply), false).as_bytes());
        return Ok(Exit::Ok);
    }
    let elapsed = reply.summary.times.values().sum();
    show(&Planned { plan: reply.plan, elapsed, summary: reply.summary.clone() });
    table(&reply).print();
    Ok(Exit::Ok)
}

/// Returns the motion as CSV: time [s], positions [rad] and velocities [rad/s] of the joints, and the tool centre
/// points in `map` [m, quaternion]. `move --path` reads its joints.
fn csv(reply: &PreviewReply) -> String {
    let joints = &reply.trajectory.joint_names;
    let robots: Vec<&String> = reply.end_effectors.keys().collect();
    let columns = joints.iter().cloned().chain(joints.iter().map(|joint| format!("{joint}_vel")));
    let tcp = |robot: &&String| ["x", "y", "z", "qx", "qy", "qz", "qw"].map(|axis| format!("{robot}.{axis}"));
    let names: Vec<String> =
        std::iter::once("time".to_owned()).chain(columns).chain(robots.iter().flat_map(tcp)).collect();
    let mut text = names.join(",") + "\n";
    for (k, point) in reply.trajectory.points.iter().enumerate() {
        let mut row = vec![point.time_from_start];
        row.extend(point.positions.iter().chain(point.velocities.iter().flatten()));
        for robot in &robots {
            row.extend(reply.end_effectors.get(*robot).and_then(|path| path.get(k)).into_iter().flatten());
            row.extend(reply.orientations.get(*robot).and_then(|path| path.get(k)).into_iter().flatten());
        }
        let cells: Vec<String> = row.iter().map(|value| format!("{value:.6}")).collect();
        text += &(cells.join(",") + "\n");
    }
    text
}

/// Parses a rate of samples.
fn rate(text: &str) -> std::result::Result<f64, String> {
    let hz = finite(text)?;
    if (0.1..=1000.0).contains(&hz) { Ok(hz) } else { Err("must be within 0.1–1000 Hz".into()) }
}

/// Returns samples of the motion, its ends included: a row per joint and coordinate, a column per time, so that any
/// number of joints fits on a narrow terminal. That has fewer samples.
fn table(reply: &PreviewReply) -> Table {
    let tcp = |arm| {
        let of = reply.tcps.get(arm).map_or_else(|| "end effector".to_owned(), TcpReport::name);
        ["x", "y", "z"].map(|axis| format!("{arm}: {of} in map {axis}"))
    };
    let tcps: Vec<String> = reply.end_effectors.keys().flat_map(tcp).collect();
    let names = reply.trajectory.joint_names.iter().chain(&tcps).map(|name| name.chars().count()).max().unwrap_or(0);
    let room = output::columns(std::io::stdout())
        .map_or(SAMPLES, |columns| usize::from(columns).saturating_sub(names) / SAMPLE_COLUMNS);
    let points = &reply.trajectory.points;
    let last = points.len().saturating_sub(1);
    let columns = room.clamp(2, SAMPLES).min(points.len());
    let index = |column: usize| if columns > 1 { column * last / (columns - 1) } else { 0 };
    let shown: Vec<usize> = (0..columns).map(index).collect();
    let times =
        shown.iter().filter_map(|i| points.get(*i)).map(|point| format!(">{} s", fixed(point.time_from_start, 2)));
    let headings: Vec<String> = std::iter::once("rad, m".to_owned()).chain(times).collect();
    let mut table = Table::new(&headings.iter().map(String::as_str).collect::<Vec<_>>());
    for (joint, name) in reply.trajectory.joint_names.iter().enumerate() {
        let at = |i: &usize| points.get(*i).and_then(|point| point.positions.get(joint)).copied();
        table.row([name.clone()].into_iter().chain(shown.iter().map(|i| number(at(i), 3))));
    }
    for (path, names) in reply.end_effectors.values().zip(tcps.chunks(3)) {
        for (axis, name) in names.iter().enumerate() {
            let at = |i: &usize| path.get(*i).and_then(|xyz| xyz.get(axis)).copied();
            table.row([name.clone()].into_iter().chain(shown.iter().map(|i| number(at(i), 3))));
        }
    }
    table
}
