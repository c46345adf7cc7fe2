//! `dimos preview`: a plan as a table of samples, or as a trajectory file.

use std::path::PathBuf;

use anyhow::Context;

use super::arguments::Target;
use super::exit::{Exit, Result};
use super::goal::{Planned, show};
use super::output::{self, Table, fixed};
use crate::rpc::api::{Preview, PreviewReply};
use crate::rpc::report::TcpReport;

/// Rows of the table.
const ROWS: usize = 12;

/// Arguments of `preview`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Number of the plan; default: the newest
    pub plan: Option<u64>,
    /// Write the trajectory to a JSON file for `dimos execute FILE`
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let reply = args.target_run.connect()?.call(Preview { plan: args.plan })?;
    if let Some(file) = &args.out {
        let text = serde_json::to_string(&reply.trajectory).unwrap_or_default();
        std::fs::write(file, text + "\n").with_context(|| file.display().to_string())?;
        output::note(format_args!("written to {}", file.display()));
    }
    if args.target_run.json {
        output::json(&reply);
        return Ok(Exit::Ok);
    }
    let elapsed = reply.summary.times.values().sum();
    show(&Planned { plan: reply.plan, elapsed, summary: reply.summary.clone() });
    table(&reply).print();
    Ok(Exit::Ok)
}

/// Returns samples of the motion, its ends included.
fn table(reply: &PreviewReply) -> Table {
    let names = reply.trajectory.joint_names.iter().map(|name| format!(">{name}"));
    let tcp = |robot| reply.tcps.get(robot).map_or_else(|| "end effector".to_owned(), TcpReport::name);
    let ends = reply.end_effectors.keys().map(|robot| format!(">{robot}: {} in map [m]", tcp(robot)));
    let headings: Vec<String> = std::iter::once(">TIME s".to_owned()).chain(names).chain(ends).collect();
    let mut table = Table::new(&headings.iter().map(String::as_str).collect::<Vec<_>>());
    let points = &reply.trajectory.points;
    let last = points.len().saturating_sub(1);
    let rows = ROWS.min(points.len());
    for row in 0..rows {
        let index = if rows > 1 { row * last / (rows - 1) } else { 0 };
        let Some(point) = points.get(index) else { continue };
        let mut cells = vec![fixed(point.time_from_start, 2)];
        cells.extend(point.positions.iter().map(|p| fixed(*p, 3)));
        let place = |path: &Vec<[f64; 3]>| path.get(index).map(|xyz| xyz.map(|v| fixed(v, 3)).join(" "));
        cells.extend(reply.end_effectors.values().map(|path| place(path).unwrap_or_default()));
        table.row(cells);
    }
    table
}
