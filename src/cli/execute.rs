//! `dimos execute FILE`: a trajectory from a file.

use std::path::PathBuf;

use super::arguments::Target;
use super::exit::{Exit, Result};
use super::follow::{Signals, follow};
use super::{output, trajectory_file};
use crate::rpc::api::Execute;

/// Arguments of `execute`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
JSON: {\"joint_names\":[\"arm_joint1\"],\"points\":[{\"time_from_start\":0,\"positions\":[0],\"velocities\":[0]},…]}
CSV:  a header `time,arm_joint1,…` and, if wanted, `arm_joint1_vel,…`; then one point per line. s, rad, rad/s.
The first point must be where the arm is.")]
pub struct Args {
    /// The trajectory: .json or .csv
    pub file: PathBuf,
    /// The trajectory task to use; without it the one whose joints cover the file's
    #[arg(long)]
    pub task: Option<String>,
    /// Return when the motion has begun
    #[arg(long)]
    pub no_wait: bool,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let trajectory = trajectory_file::read(&args.file)?;
    let mut client = args.target_run.connect()?;
    let points = trajectory.points.len();
    let signals = (!args.no_wait).then(Signals::watch);
    let begun = client.call(Execute { trajectory, task: args.task.clone() })?;
    output::note(format_args!(
        "motion {} on {}: {points} points, {:.2} s, not collision-checked",
        begun.motion, begun.task, begun.duration
    ));
    match signals {
        Some(signals) => follow(&mut client, begun.motion, &begun.task, &signals, args.target_run.json),
        None => {
            if args.target_run.json {
                output::json(&begun);
            }
            Ok(Exit::Ok)
        }
    }
}
