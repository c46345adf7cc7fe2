//! `dimos model check`: every mistake of a description, its meshes, its SRDF and its limits.

use std::collections::BTreeSet;

use super::File;
use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::output;
use crate::planning::planning_scene::{always_touch, whole};
use crate::robot::mesh::Mesh;
use crate::robot::urdf::Meshes;
use crate::robot::{Geometry, Loaded, RobotModel, Shape};
use crate::yaml::Diag;

/// Runs the verb.
pub(super) fn run(file: &File) -> Result {
    let mut loaded = file.load(Meshes::Find);
    let summary = loaded.model.take().map(|robot| {
        let triangles = read_meshes(&robot, &mut loaded);
        let (links, independent) = (robot.links.len(), robot.independent_joints().len());
        let summary = format!("{}: {links} links, {independent} independent joints, {triangles} triangles", robot.name);
        touching_links(robot, &mut loaded);
        summary
    });
    let fine = summary.is_some() && !loaded.has_errors();
    if file.json {
        output::json(&serde_json::json!({"valid": fine, "problems": loaded.reports(), "files": loaded.files}));
        return Ok(if fine { Exit::Ok } else { Exit::Usage });
    }
    let text = loaded.render(output::colour(&std::io::stderr()));
    if !text.is_empty() {
        output::note(text.trim_end());
    }
    match summary.filter(|_| fine) {
        Some(summary) => {
            output::line(summary);
            let warnings = loaded.warnings();
            output::line(match warnings {
                0 => "no mistakes".to_owned(),
                1 => "no mistakes, 1 warning".to_owned(),
                more => format!("no mistakes, {more} warnings"),
            });
            Ok(Exit::Ok)
        }
        None => Err(Failure::usage(format!("{} has mistakes", file.file.display()))),
    }
}

/// Warns of links that touch in every configuration: a planner cannot check them against each other.
fn touching_links(robot: RobotModel, loaded: &mut Loaded) {
    let allowed = loaded.semantics.disabled_pairs().collect();
    // Errors of shapes were reported with the meshes; others appear only here.
    let touching = match whole(robot, allowed) {
        Ok(robot) => always_touch(&robot),
        Err(_) if loaded.has_errors() => return,
        Err(why) => return loaded.report(Diag::error(why)),
    };
    for (number, [a, b]) in touching.iter().enumerate() {
        let what = format!("the links `{a}` and `{b}` touch in every configuration: a planner does not check them");
        let hint = "if that is intended, exclude the pair: disable_collisions in an SRDF, or collision_exclusion_pairs";
        let last = (number + 1 == touching.len()).then(|| hint.to_owned());
        loaded.report(Diag::warning(what).maybe_hint(last));
    }
}

/// Reads all meshes; returns their number of triangles. An unreadable collision mesh is an error.
fn read_meshes(robot: &RobotModel, loaded: &mut Loaded) -> usize {
    let mut triangles = 0;
    let mut seen = BTreeSet::new();
    for link in &robot.links {
        let collisions = link.collisions.iter().map(|shape| (shape, true));
        for (shape, collides) in collisions.chain(link.visuals.iter().map(|shape| (shape, false))) {
            let Shape { geometry: Geometry::Mesh(mesh), .. } = shape else { continue };
            if mesh.path.is_none() || !seen.insert((mesh.path.clone(), collides)) {
                continue;
            }
            match Mesh::load(mesh) {
                Ok(mesh) => triangles += mesh.triangles.len(),
                Err(why) => {
                    let what = format!("unusable mesh of the link `{}`: {why}", link.name);
                    loaded.report(if collides { Diag::error(what) } else { Diag::warning(what) });
                }
            }
        }
    }
    triangles
}
