//! `dimos model ik`: joint positions for a pose of a link.

use glamx::{DAffine3, DQuat, DVec3};
use serde_json::json;

use super::File;
use super::fk::{deepest, index};
use crate::cli::arguments::finite;
use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::output;
use crate::collision::checker::Stop;
use crate::planning::ik::{Ik, IkSettings};
use crate::pose::from_xyz_rpy;
use crate::robot::kinematics::Kinematics;
use crate::robot::urdf::Meshes;

/// Arguments of `model ik`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
The joints are the independent ones between the root and the link, in order from the base, as in `model fk`.
Collisions are not checked: use `dimos plan` for that. The same call gives the same answer.")]
pub struct Args {
    #[command(flatten)]
    file: File,
    /// Target position of the link: x, y, z [m] in the root's frame; orientation is free unless --rpy or --quat is
    /// given
    #[arg(long, value_names = ["X", "Y", "Z"], num_args = 3, value_parser = finite, allow_negative_numbers = true, required = true)]
    pose: Vec<f64>,
    /// Target roll, pitch, yaw about fixed axes [rad]
    #[arg(long, value_names = ["R", "P", "Y"], num_args = 3, value_parser = finite, allow_negative_numbers = true)]
    rpy: Option<Vec<f64>>,
    /// Target orientation as a quaternion x, y, z, w
    #[arg(long, value_names = ["X", "Y", "Z", "W"], num_args = 4, value_parser = finite, allow_negative_numbers = true, conflicts_with = "rpy")]
    quat: Option<Vec<f64>>,
    /// Leave the orientation free
    #[arg(long, conflicts_with_all = ["rpy", "quat"])]
    position_only: bool,
    /// Link to place; default: the end of the longest chain
    #[arg(long, value_name = "NAME")]
    link: Option<String>,
    /// Seed: the nearest solution is printed [rad, or m for prismatic joints]; default: zero
    #[arg(long, value_name = "Q", num_args = 1.., value_parser = finite, allow_negative_numbers = true)]
    seed: Option<Vec<f64>>,
}

/// Number of solutions to search, of which the nearest is printed.
const SOLUTIONS: usize = 8;

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let (robot, _) = args.file.robot(Meshes::Ignore)?;
    let link = args.link.as_deref().map_or_else(|| Ok(deepest(&robot)), |name| index(&robot, name))?;
    let name = robot.links.get(link).map_or("?", |l| l.name.as_str());
    let chain = robot.chain(0, link).unwrap_or_default();
    let independent = |j: &usize| robot.joints.get(*j).is_some_and(|joint| joint.is_independent());
    let joints: Vec<usize> = chain.into_iter().filter(independent).collect();
    let kinematics = Kinematics::new(&robot, &joints, &[]).map_err(|e| Failure::usage(e.to_string()))?;
    if joints.is_empty() {
        return Err(Failure::usage(format!("no joint moves `{name}`")));
    }
    let names = kinematics.names();
    let seed = args.seed.clone().unwrap_or_else(|| vec![0.0; joints.len()]);
    if seed.len() != joints.len() {
        let what = format!("--seed takes {} positions, found {}", joints.len(), seed.len());
        return Err(Failure::usage(what).hint(format!("the joints are: {}", names.join(" "))));
    }
    let turn = orientation(args)?;
    let target = DAffine3::from_rotation_translation(turn.unwrap_or(DQuat::IDENTITY), vector(&args.pose));
    let position_only = turn.is_none();
    let settings = IkSettings { position_only, solutions: SOLUTIONS, ..IkSettings::default() };
    let mut ik = Ik::new(&kinematics, link);
    match ik.solve(&target, &seed, &settings, |_| true, &Stop::never()) {
        Ok(found) => {
            let q = found.first().cloned().unwrap_or_default();
            let at = ik.pose(&q);
            let missing = at.translation.distance(target.translation);
            if args.file.json {
                output::json(&json!({
                    "reached": true, "link": name, "joints": names, "positions": q, "position_only": position_only,
                    "position_error": missing, "solutions": found.len(),
                }));
            } else {
                output::line(format_args!("{name}: {}", names.join(" ")));
                output::line(q.iter().map(|v| output::fixed(*v, 6)).collect::<Vec<_>>().join(" "));
            }
            Ok(Exit::Ok)
        }
        Err(failure) if args.file.json => {
            output::json(&json!({
                "reached": false, "link": name, "joints": names, "best": failure.best, "position_only": position_only,
                "position_error": failure.position, "rotation_error": failure.rotation,
                "limit": failure.limit.as_ref().map(|(_, joint)| joint), "attempts": failure.attempts,
            }));
            Ok(Exit::Failed)
        }
        Err(failure) => {
            let best: Vec<String> = failure.best.iter().map(|v| output::fixed(*v, 4)).collect();
            let hint = format!("the closest configuration found is {}", best.join(" "));
            Err(Failure::new(Exit::Failed, failure.to_string()).hint(hint))
        }
    }
}

/// Returns the requested orientation, if any.
fn orientation(args: &Args) -> Result<Option<DQuat>> {
    if let Some([r, p, y]) = args.rpy.as_deref() {
        let q = from_xyz_rpy([0.0; 3], [*r, *p, *y]).rotation.coords;
        return Ok(Some(DQuat::from_xyzw(q.x, q.y, q.z, q.w)));
    }
    let Some([x, y, z, w]) = args.quat.as_deref() else { return Ok(None) };
    let quat = DQuat::from_xyzw(*x, *y, *z, *w);
    if !(0.99..=1.01).contains(&quat.length()) {
        let what = format!("--quat has length {}, must be 1", quat.length());
        return Err(Failure::usage(what).hint("the identity is 0 0 0 1"));
    }
    Ok(Some(quat.normalize()))
}

fn vector(values: &[f64]) -> DVec3 {
    let at = |i: usize| values.get(i).copied().unwrap_or_default();
    DVec3::new(at(0), at(1), at(2))
}
