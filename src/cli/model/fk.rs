//! `dimos model fk`: the pose of a link at joint positions.

use std::time::Duration;

use nalgebra::Isometry3;
use serde_json::json;

use super::File;
use super::chain::{Chain, check_count};
use crate::cli::arguments::finite;
use crate::cli::exit::{Exit, Result};
use crate::cli::output;
use crate::cli::targets::{Source, Width};
use dimos_core::pose::to_xyz_rpy;
use dimos_robot::RobotModel;
use dimos_robot::urdf::Meshes;

/// Arguments of `model fk`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
The joints are the independent ones between the two links, in order from the base. Neither link must be below the \
other.
With --stdin a line is a configuration, as numbers or a JSON array, and prints x y z [m] and a quaternion x y z w.")]
pub struct Args {
    #[command(flatten)]
    file: File,
    /// Joint positions [rad, or m for prismatic joints]
    #[arg(value_name = "Q", value_parser = finite, allow_negative_numbers = true)]
    positions: Vec<f64>,
    /// Link whose pose is printed; default: the end of the arm
    #[arg(long, value_name = "NAME")]
    link: Option<String>,
    /// Reference link of the pose; default: the root
    #[arg(long, value_name = "NAME")]
    base: Option<String>,
    /// Read configurations from stdin, one per line
    #[arg(long, conflicts_with = "positions")]
    stdin: bool,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let (robot, _) = args.file.robot(Meshes::Ignore)?;
    let chain = Chain::between(&robot, args.base.as_deref(), args.link.as_deref())?;
    if args.stdin {
        return batch(args, &robot, &chain);
    }
    check_count(chain.name(chain.link), &chain.names(), &args.positions)?;
    chain.outside(&args.positions).iter().for_each(output::note);
    let pose = pose(&robot, &chain, &args.positions);
    if args.file.json {
        output::json(&report(&chain, &args.positions, &pose));
        return Ok(Exit::Ok);
    }
    let (xyz, rpy) = to_xyz_rpy(&pose);
    output::line(format_args!("{} in {}", chain.name(chain.link), chain.name(chain.base)));
    output::line(format_args!("xyz   {}  m", row(&xyz)));
    output::line(format_args!("rpy   {}  rad", row(&rpy)));
    output::line(format_args!("quat  {}  x y z w", row(pose.rotation.quaternion().coords.as_slice())));
    Ok(Exit::Ok)
}

/// Prints a line per configuration of stdin.
fn batch(args: &Args, robot: &RobotModel, chain: &Chain<'_>) -> Result {
    let mut configurations = Source::stdin(Width::Joints(chain.joints.len()), "model fk");
    while !configurations.is_over() {
        let Some(positions) = configurations.next(Duration::from_secs(1))? else { continue };
        let pose = pose(robot, chain, &positions);
        if args.file.json {
            output::json(&report(chain, &positions, &pose));
        } else {
            let (xyz, _) = to_xyz_rpy(&pose);
            output::line(row(&[&xyz, pose.rotation.quaternion().coords.as_slice()].concat()));
        }
    }
    Ok(Exit::Ok)
}

/// Returns the pose of the chain's link in its base, all other joints at zero.
fn pose(robot: &RobotModel, chain: &Chain<'_>, positions: &[f64]) -> Isometry3<f64> {
    let named = chain.names().into_iter().map(str::to_owned).zip(positions.iter().copied()).collect();
    let poses = robot.link_poses(&robot.positions(&named));
    let at = |link: usize| poses.get(link).copied().unwrap_or_default();
    at(chain.base).inverse() * at(chain.link)
}

fn report(chain: &Chain<'_>, positions: &[f64], pose: &Isometry3<f64>) -> serde_json::Value {
    let (xyz, rpy) = to_xyz_rpy(pose);
    json!({
        "link": chain.name(chain.link), "base": chain.name(chain.base), "joints": chain.names(),
        "positions": positions, "xyz": xyz, "rpy": rpy, "quat": pose.rotation.quaternion().coords.as_slice(),
    })
}

fn row(values: &[f64]) -> String {
    values.iter().map(|v| output::fixed(*v, 6)).collect::<Vec<_>>().join(" ")
}
