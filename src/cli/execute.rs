//! `dimos execute`: executes the newest plan of `dimos plan`, or a trajectory from a file.

use std::path::PathBuf;

use super::arguments::Target;
use super::exit::{Exit, Failure, Result};
use super::follow::Signals;
use super::{full_speed, going, output, trajectory_file};
use dimos_rpc::api::{Execute, ExecutePlan, ExecuteReply, GoBegun, GoStep, Planner, Planning, Trajectory};
use dimos_rpc::client::Client;

/// Arguments of `execute`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
JSON: {\"joint_names\":[\"arm_joint1\"],\"points\":[{\"time_from_start\":0,\"positions\":[0],\"velocities\":[0]},…]}
CSV:  a header `time,arm_joint1,…` and optionally `arm_joint1_vel,…`; then one point per line. s, rad, rad/s.
The first point must be the arm's position.")]
pub struct Args {
    /// Trajectory file, .json or .csv; default: the newest plan of `dimos plan`
    pub file: Option<PathBuf>,
    /// Execute the plan with this number
    #[arg(long, value_name = "N", conflicts_with = "file")]
    pub plan: Option<u64>,
    /// Trajectory task to use; default: the one whose joints cover those of the file
    #[arg(long, requires = "file")]
    pub task: Option<String>,
    /// If an obstacle blocks the motion, stop, plan again and continue
    #[arg(long, conflicts_with_all = ["file", "no_wait"])]
    pub replan: bool,
    /// Execute a plan of --level fast, which is not proven free of contact
    #[arg(long, conflicts_with = "file")]
    pub unproven: bool,
    /// Return when the motion has begun
    #[arg(long)]
    pub no_wait: bool,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let is_number = |file: &PathBuf| file.to_string_lossy().parse::<u64>().is_ok() && !file.exists();
    if let Some(number) = args.file.as_ref().filter(|file| is_number(file)) {
        let number = number.display();
        return Err(Failure::usage(format!("there is no trajectory file {number}"))
            .hint(format!("a plan is given by its number with --plan {number}")));
    }
    let trajectory = args.file.as_deref().map(trajectory_file::read).transpose()?;
    let mut client = args.target_run.connect()?;
    let signals = (!args.no_wait).then(Signals::watch);
    let (going, begun) = match trajectory {
        Some(mut trajectory) => {
            let joints = trajectory.joint_names.clone();
            stretch(&mut trajectory, full_speed::limit_of(&mut client, |_| Ok(Some(joints)))?);
            let points = trajectory.points.len();
            let execute = Execute { trajectory, task: args.task.clone(), retraces_to: None };
            begin(&mut client, GoStep::Execute(Box::new(execute)), signals.as_ref(), |begun| {
                let ExecuteReply { motion, task, duration } = begun;
                format!("motion {motion} on {task}: {points} points, {duration:.2} s, not collision-checked")
            })?
        }
        None => {
            // The plan that is judged is the one that is executed.
            let mut plan = args.plan;
            let max_speed = full_speed::limit_of(&mut client, |client| {
                plan =
                    plan.map_or_else(|| client.call(Planner {}).map(|planner| planner.plan), |plan| Ok(Some(plan)))?;
                joints_of(client, plan)
            })?;
            let execute = ExecutePlan {
                plan,
                replan: args.replan,
                unproven: args.unproven,
                max_speed: Some(max_speed).filter(|speed| *speed < 1.0),
                ..ExecutePlan::default()
            };
            let checked = if args.unproven { "" } else { ", collision-checked" };
            begin(&mut client, GoStep::ExecutePlan(Box::new(execute)), signals.as_ref(), |begun| {
                let ExecuteReply { motion, task, duration } = begun;
                format!("motion {motion} on {task}: {duration:.2} s, planned{checked}")
            })?
        }
    };
    match signals {
        Some(signals) => going::finish(&mut client, going, &begun, &signals, args.target_run.json),
        None => {
            if args.target_run.json {
                output::json(&begun);
            }
            Ok(Exit::Ok)
        }
    }
}

/// Begins a motion, and prints what it does.
fn begin(
    client: &mut Client,
    step: GoStep,
    signals: Option<&Signals>,
    text: impl FnOnce(&ExecuteReply) -> String,
) -> Result<(u64, GoBegun)> {
    let going = going::go(client, step)?;
    let begun = going::begin(client, (going, 0), signals, false)?.reply;
    if let GoBegun::Execute(reply) = &begun {
        output::note(text(reply));
    }
    Ok((going, begun))
}

/// Slows a trajectory to this fraction of its speed.
fn stretch(trajectory: &mut Trajectory, speed: f64) {
    for point in &mut trajectory.points {
        point.time_from_start /= speed;
        point.velocities.iter_mut().flatten().for_each(|v| *v *= speed);
        point.accelerations.iter_mut().flatten().for_each(|a| *a *= speed * speed);
    }
}

/// Returns the joints that a plan moves; `None` if that is not known.
fn joints_of(client: &mut Client, plan: Option<u64>) -> Result<Option<Vec<String>>> {
    let report = plan.map(|plan| client.call(Planning { plan })).transpose()?;
    Ok(report.and_then(|report| report.summary).map(|summary| summary.joints))
}
