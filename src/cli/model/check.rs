//! `dimos model check`: every mistake of a description, of the meshes it names, and of its SRDF and limits.

use std::collections::BTreeSet;

use super::File;
use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::output;
use crate::robot::mesh::Mesh;
use crate::robot::urdf::Meshes;
use crate::robot::{Geometry, Loaded, RobotModel, Shape};
use crate::yaml::Diag;

/// Runs the verb.
pub(super) fn run(file: &File) -> Result {
    let mut loaded = file.load(Meshes::Find);
    let summary = loaded.model.take().map(|robot| {
        let triangles = read_meshes(&robot, &mut loaded);
        let independent = robot.independent_joints().len();
        format!(
            "{}: {} links, {independent} joints that move on their own, {triangles} triangles",
            robot.name,
            robot.links.len()
        )
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
            output::line(if warnings == 0 {
                "no mistakes".to_owned()
            } else {
                format!("no mistakes, {warnings} warnings")
            });
            Ok(Exit::Ok)
        }
        None => Err(Failure::usage(format!("{} has mistakes", file.file.display()))),
    }
}

/// Reads all meshes; the number of their triangles. One that cannot be read is a mistake if links collide by it.
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
                    let what = format!("a mesh of the link `{}` cannot be used: {why}", link.name);
                    loaded.report(if collides { Diag::error(what) } else { Diag::warning(what) });
                }
            }
        }
    }
    triangles
}
