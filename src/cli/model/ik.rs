//! `dimos model ik`: joint positions for a pose of a link.

use std::collections::HashMap;

use glamx::{DAffine3, DQuat, DVec3};
use serde_json::json;

use super::File;
use super::chain::Chain;
use crate::cli::arguments::{angle, finite, length};
use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::output::{self, Table};
use dimos_core::pose::from_xyz_rpy;
use dimos_planner::collision::checker::Stop;
use dimos_planner::planning::ik::Ik;
use dimos_planner::planning::ik::settings::IkSettings;
use dimos_planner::planning::search::path::distance;
use dimos_robot::kinematics::{Kinematics, frame};
use dimos_robot::urdf::Meshes;

/// Arguments of `model ik`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
The joints are the independent ones between base and link, in order from the base, as in `model fk`; all others are at \
zero. The solution closest to the seed that a bounded search finds is printed, with its distance (Euclidean over the \
joints). Collisions are not checked: `model collide` does that. The same call gives the same answer.")]
pub struct Args {
    #[command(flatten)]
    file: File,
    /// Target position of the link: x, y, z [m] in the base's frame; orientation is free unless --rpy or --quat is
    /// given
    #[arg(long, value_names = ["X", "Y", "Z"], num_args = 3, value_parser = length, allow_negative_numbers = true, required = true)]
    pose: Vec<f64>,
    /// Target roll, pitch, yaw about fixed axes [rad]
    #[arg(long, value_names = ["R", "P", "Y"], num_args = 3, value_parser = angle, allow_negative_numbers = true)]
    rpy: Option<Vec<f64>>,
    /// Target orientation as a quaternion x, y, z, w
    #[arg(long, value_names = ["X", "Y", "Z", "W"], num_args = 4, value_parser = finite, allow_negative_numbers = true, conflicts_with = "rpy")]
    quat: Option<Vec<f64>>,
    /// Leave the orientation free
    #[arg(long, conflicts_with_all = ["rpy", "quat"])]
    position_only: bool,
    /// Link to place; default: the end of the arm
    #[arg(long, value_name = "NAME")]
    link: Option<String>,
    /// Reference link of the pose, above the link; default: the root
    #[arg(long, value_name = "NAME")]
    base: Option<String>,
    /// Move only the joints of this SRDF group; places its last link unless --link is given
    #[arg(long, value_name = "NAME")]
    group: Option<String>,
    /// Seed: the closest solution is printed [rad, or m for prismatic joints]; default: zero
    #[arg(long, value_name = "Q", num_args = 1.., value_parser = finite, allow_negative_numbers = true)]
    seed: Option<Vec<f64>>,
    /// Tolerance of position [m] and orientation [rad]
    #[arg(long, value_name = "M", value_parser = tolerance, default_value_t = IkSettings::default().position)]
    tolerance: f64,
    /// Print all solutions found, the closest to the seed first
    #[arg(long)]
    all: bool,
}

/// Number of solutions of the plain search.
const SOLUTIONS: usize = 24;

/// Parses a tolerance: above the rounding errors of the kinematics.
fn tolerance(text: &str) -> std::result::Result<f64, String> {
    let value = finite(text)?;
    if (1e-9..=0.1).contains(&value) { Ok(value) } else { Err("must be within 1e-9–0.1".into()) }
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let (robot, loaded) = args.file.robot(Meshes::Ignore)?;
    let (base, link) = (args.base.as_deref(), args.link.as_deref());
    let chain = match &args.group {
        Some(group) => Chain::of_group(&robot, &loaded.semantics, group, base, link)?,
        None => Chain::between(&robot, base, link)?,
    };
    let name = chain.name(chain.link);
    if robot.chain(chain.base, chain.link).is_none() {
        let failure = Failure::usage(format!("`{name}` is not below `{}`", chain.name(chain.base)));
        return Err(failure.hint("the base of `ik` must not move: choose a link above the joints"));
    }
    let moves = |joint: &&usize| robot.chain(**joint + 1, chain.base).is_some();
    if let Some(joint) = chain.joints.iter().find(moves).and_then(|joint| robot.joints.get(*joint)) {
        return Err(Failure::usage(format!("`{}` moves the base `{}`", joint.name, chain.name(chain.base))));
    }
    let rest = robot.positions(&HashMap::new());
    let kinematics = Kinematics::new(&robot, &chain.joints, &rest).map_err(|e| Failure::usage(e.to_string()))?;
    if chain.joints.is_empty() {
        return Err(Failure::usage(format!("no joint moves `{name}`")));
    }
    let seed = args.seed.clone().unwrap_or_else(|| vec![0.0; chain.joints.len()]);
    if seed.len() != chain.joints.len() {
        let what = format!("--seed takes {} positions, found {}", chain.joints.len(), seed.len());
        return Err(Failure::usage(what).hint(format!("the joints are: {}", chain.names().join(" "))));
    }
    if args.seed.is_some() {
        chain.outside(&seed).iter().for_each(output::note);
    }
    let turn = orientation(args)?;
    let in_base = DAffine3::from_rotation_translation(turn.unwrap_or(DQuat::IDENTITY), vector(&args.pose));
    let target = frame(&robot.link_poses(&rest).get(chain.base).copied().unwrap_or_default()) * in_base;
    let (position, rotation) = (args.tolerance, args.tolerance);
    let settings =
        IkSettings { position, rotation, position_only: turn.is_none(), solutions: SOLUTIONS, ..IkSettings::default() };
    let mut ik = Ik::new(&kinematics, chain.link);
    match ik.closest(&target, &seed, &settings, |_| true, &Stop::never()) {
        Ok(found) => {
            let missing = |ik: &mut Ik<'_>, q: &[f64]| ik.pose(q).translation.distance(target.translation);
            let error = missing(&mut ik, found.first().map_or(&[], Vec::as_slice));
            show(args, &chain, &found, &seed, error, turn.is_none());
            Ok(Exit::Ok)
        }
        Err(failure) => {
            let best: Vec<String> = failure.best.iter().map(|v| output::fixed(*v, 4)).collect();
            let hint = format!("the closest configuration found is {}", best.join(" "));
            let refused = Failure::new(Exit::Failed, failure.to_string()).hint(hint);
            if !args.file.json {
                return Err(refused);
            }
            output::json(&json!({
                "reached": false, "link": name, "base": chain.name(chain.base), "joints": chain.names(),
                "best": failure.best, "position_only": turn.is_none(), "position_error": failure.position,
                "rotation_error": failure.rotation, "limit": failure.limit.as_ref().map(|(_, joint)| joint),
                "attempts": failure.attempts,
            }));
            Err(refused)
        }
    }
}

/// Prints solutions, the closest to the seed first: that one, or all. `error` is the position error of the first [m].
fn show(args: &Args, chain: &Chain<'_>, found: &[Vec<f64>], seed: &[f64], error: f64, position_only: bool) {
    let name = chain.name(chain.link);
    let closest = found.first().cloned().unwrap_or_default();
    if args.file.json {
        let mut report = json!({
            "reached": true, "link": name, "base": chain.name(chain.base), "joints": chain.names(),
            "positions": closest, "distance": distance(seed, &closest), "position_only": position_only,
            "position_error": error, "solutions": found.len(),
        });
        if args.all {
            let each = found.iter().map(|q| json!({"positions": q, "distance": distance(seed, q)}));
            report["all"] = each.collect();
        }
        return output::json(&report);
    }
    let fixed = |q: &[f64]| q.iter().map(|v| output::fixed(*v, 6)).collect::<Vec<_>>();
    if args.all {
        let names = chain.names().into_iter().map(|name| format!(">{name}"));
        let headings: Vec<String> = [">DISTANCE".to_owned()].into_iter().chain(names).collect();
        let mut table = Table::new(&headings.iter().map(String::as_str).collect::<Vec<_>>());
        for q in found {
            table.row([vec![output::fixed(distance(seed, q), 3)], fixed(q)].concat());
        }
        return table.print();
    }
    output::line(format_args!("{name}: {}", chain.names().join(" ")));
    output::line(fixed(&closest).join(" "));
    output::line(format_args!("distance to the seed: {}", output::fixed(distance(seed, &closest), 3)));
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
