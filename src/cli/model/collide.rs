//! `dimos model collide`: the pairs of links that touch or are close at joint positions.

use std::collections::HashMap;

use serde_json::json;

use super::File;
use super::chain::{check_count, group_joints};
use crate::cli::arguments::finite;
use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::output::{self, Table};
use dimos_planner::collision::world::World;
use dimos_planner::collision::{CheckSettings, ExactChecker};
use dimos_planner::planning::scene::planning_scene::{always_touch, whole};
use dimos_robot::RobotModel;
use dimos_robot::urdf::Meshes;

/// Arguments of `model collide`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
The joints are all independent ones in the order of `model info`, or those of the group; the others are at the position \
in their limits that is closest to zero. Neighbouring links, the pairs of the SRDF's disable_collisions and links that \
touch in every configuration are not checked, as in a plan. Exit code 1 if links touch.")]
pub struct Args {
    #[command(flatten)]
    file: File,
    /// Joint positions [rad, or m for prismatic joints]
    #[arg(value_name = "Q", value_parser = finite, allow_negative_numbers = true)]
    positions: Vec<f64>,
    /// Take the positions of the joints of this SRDF group only
    #[arg(long, value_name = "NAME")]
    group: Option<String>,
    /// Show pairs closer than this [m]
    #[arg(long, value_name = "M", value_parser = margin, default_value_t = 0.05)]
    within: f64,
}

/// Parses a distance.
fn margin(text: &str) -> std::result::Result<f64, String> {
    let value = finite(text)?;
    if (0.0..=10.0).contains(&value) { Ok(value) } else { Err("must be within 0–10 m".into()) }
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let (robot, loaded) = args.file.robot(Meshes::Find)?;
    let joints = match &args.group {
        Some(group) => group_joints(&robot, &loaded.semantics, group)?,
        None => robot.independent_joints(),
    };
    let names: Vec<&str> = joints.iter().filter_map(|j| robot.joints.get(*j)).map(|j| j.name.as_str()).collect();
    check_count(&robot.name, &names, &args.positions)?;
    let q = configuration(&robot, &names, &args.positions);
    let mut body = whole(robot.clone(), loaded.semantics.disabled_pairs().collect()).map_err(Failure::usage)?;
    let unchecked = always_touch(&body);
    body.allowed.extend(unchecked.iter().cloned().map(<(String, String)>::from));
    let mut world = World::new();
    world.add_robot(body).map_err(|e| Failure::usage(e.to_string()))?;
    let mut checker = ExactChecker::new(world.snapshot(), CheckSettings::default()).with_margin(args.within);
    let mut close: Vec<_> = checker.closer_than_padding(&q).into_iter().map(|(_, contact)| contact).collect();
    close.sort_by(|a, b| a.distance.total_cmp(&b.distance));
    let touching = close.iter().filter(|contact| contact.distance <= 0.0).count();
    let exit = if touching == 0 { Exit::Ok } else { Exit::Failed };
    if args.file.json {
        let pairs = close.iter().map(|contact| {
            let points = [contact.on_link.to_array(), contact.on_other.to_array()];
            json!({"links": [contact.link, contact.other], "distance": contact.distance, "points": points})
        });
        output::json(&json!({
            "free": touching == 0, "joints": names, "positions": args.positions, "within": args.within,
            "pairs": pairs.collect::<Vec<_>>(), "unchecked": unchecked,
        }));
        return Ok(exit);
    }
    for [a, b] in &unchecked {
        output::note(format_args!("not checked: {a} and {b} touch in every configuration"));
    }
    if !close.is_empty() {
        let mut table = Table::new(&["LINK", "LINK", ">DISTANCE m", ""]);
        for contact in &close {
            let touches = if contact.distance <= 0.0 { "touches" } else { "" };
            let distance = output::fixed(contact.distance, 4);
            table.row([contact.link.clone(), contact.other.clone(), distance, touches.to_owned()]);
        }
        table.print();
    }
    let within = output::fixed(args.within, 4);
    output::line(match (touching, close.len()) {
        (0, 0) => format!("free: no two links are within {within} m"),
        (0, _) => "free".to_owned(),
        (1, _) => "1 pair of links touches; a negative distance is the penetration depth".to_owned(),
        (more, _) => format!("{more} pairs of links touch; a negative distance is the penetration depth"),
    });
    Ok(exit)
}

/// Returns the positions of all independent joints; those not named are as close to zero as their limits allow.
/// Positions outside the limits are reported.
fn configuration(robot: &RobotModel, names: &[&str], positions: &[f64]) -> Vec<f64> {
    let named: HashMap<&str, f64> = names.iter().copied().zip(positions.iter().copied()).collect();
    let position = |index: usize| {
        let Some(joint) = robot.joints.get(index) else { return 0.0 };
        let (limits, unit) = (joint.limits, joint.kind.unit());
        let Some(q) = named.get(joint.name.as_str()).copied() else {
            return 0.0_f64.max(limits.lower).min(limits.upper);
        };
        if !(limits.lower..=limits.upper).contains(&q) {
            let (name, lower, upper) = (&joint.name, limits.lower, limits.upper);
            output::note(format_args!(
                "warning: {name} at {q} {unit} is outside its limits {lower:.4} to {upper:.4} {unit}"
            ));
        }
        q
    };
    robot.independent_joints().into_iter().map(position).collect()
}
