//! `dimos model fk`: the pose of a link at joint positions.

use serde_json::json;

use super::File;
use crate::cli::arguments::finite;
use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::output;
use crate::pose::to_xyz_rpy;
use crate::robot::RobotModel;
use crate::robot::urdf::Meshes;
use crate::yaml::did_you_mean;

/// Arguments of `model fk`.
#[derive(Debug, clap::Args)]
#[command(after_help = "The joints are the independent ones between the two links, in order from the base.")]
pub struct Args {
    #[command(flatten)]
    file: File,
    /// Joint positions [rad, or m for prismatic joints]
    #[arg(value_name = "Q", value_parser = finite, allow_negative_numbers = true)]
    positions: Vec<f64>,
    /// Link whose pose is printed; default: the end of the longest chain
    #[arg(long, value_name = "NAME")]
    link: Option<String>,
    /// Reference link of the pose; default: the root
    #[arg(long, value_name = "NAME")]
    base: Option<String>,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let (robot, _) = args.file.robot(Meshes::Ignore)?;
    let base = args.base.as_deref().map_or(Ok(0), |name| index(&robot, name))?;
    let tip = args.link.as_deref().map_or_else(|| Ok(deepest(&robot)), |name| index(&robot, name))?;
    let name = |link: usize| robot.links.get(link).map_or("?", |l| l.name.as_str());
    let Some(chain) = robot.chain(base, tip) else {
        return Err(Failure::usage(format!("`{}` is not below `{}`", name(tip), name(base))));
    };
    let moving: Vec<&str> = chain
        .iter()
        .filter_map(|i| robot.joints.get(*i))
        .filter(|joint| joint.is_independent())
        .map(|joint| joint.name.as_str())
        .collect();
    if moving.len() != args.positions.len() {
        let what = format!("`{}` takes {} positions, found {}", name(tip), moving.len(), args.positions.len());
        return Err(Failure::usage(what).hint(format!("the joints are: {}", moving.join(" "))));
    }
    for (joint, q) in moving.iter().zip(&args.positions) {
        let joint = robot.joint_index(joint).and_then(|i| robot.joints.get(i));
        if let Some(joint) = joint.filter(|j| *q < j.limits.lower || *q > j.limits.upper) {
            let (name, unit, limits) = (&joint.name, joint.kind.unit(), joint.limits);
            output::note(format_args!(
                "warning: {name} at {q} {unit} is outside its limits {:.4} to {:.4} {unit}",
                limits.lower, limits.upper
            ));
        }
    }
    let named = moving.iter().map(|joint| (*joint).to_owned()).zip(args.positions.iter().copied()).collect();
    let poses = robot.link_poses(&robot.positions(&named));
    let at = |link: usize| poses.get(link).copied().unwrap_or_default();
    let pose = at(base).inverse() * at(tip);
    let (xyz, rpy) = to_xyz_rpy(&pose);
    let q = pose.rotation.quaternion().coords;
    if args.file.json {
        output::json(&json!({
            "link": name(tip), "base": name(base), "joints": moving, "positions": args.positions,
            "xyz": xyz, "rpy": rpy, "quat_xyzw": q.as_slice(),
        }));
        return Ok(Exit::Ok);
    }
    let row = |values: &[f64]| values.iter().map(|v| output::fixed(*v, 6)).collect::<Vec<_>>().join(" ");
    output::line(format_args!("{} in {}", name(tip), name(base)));
    output::line(format_args!("xyz   {}  m", row(&xyz)));
    output::line(format_args!("rpy   {}  rad", row(&rpy)));
    output::line(format_args!("quat  {}  x y z w", row(q.as_slice())));
    Ok(Exit::Ok)
}

pub(super) fn index(robot: &RobotModel, name: &str) -> Result<usize> {
    robot.link_index(name).ok_or_else(|| {
        let hint = did_you_mean(name, robot.links.iter().map(|l| l.name.as_str()), "the links are");
        Failure { hint, ..Failure::usage(format!("{} has no link `{name}`", robot.name)) }
    })
}

/// Returns the first link with the longest chain of joints.
pub(super) fn deepest(robot: &RobotModel) -> usize {
    let mut depths = vec![0; robot.links.len()];
    for joint in &robot.joints {
        depths[joint.child] = depths[joint.parent] + 1;
    }
    let most = depths.iter().max().copied().unwrap_or(0);
    depths.iter().position(|d| *d == most).unwrap_or(0)
}
