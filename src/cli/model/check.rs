//! `dimos model check`: every mistake of a description, its meshes, its SRDF and its limits.

use super::{File, has_mistakes};
use crate::cli::exit::{Exit, Result};
use crate::cli::output;
use crate::offline::always_touching;
use dimos_robot::urdf::Meshes;
use dimos_robot::{Loaded, RobotModel, judge};
use dimos_yaml::{Diag, quote};

/// Runs the verb.
pub(super) fn run(file: &File) -> Result {
    let mut loaded = file.load(Meshes::Find);
    let summary = loaded.model.take().map(|robot| {
        let meshes = judge(&mut loaded, &robot);
        poses_outside_limits(&robot, &mut loaded);
        let (links, independent) = (robot.links.len(), robot.independent_joints().len());
        let triangles = meshes.triangles();
        let summary = format!("{}: {links} links, {independent} independent joints, {triangles} triangles", robot.name);
        touching_links(robot, &mut loaded);
        summary
    });
    let fine = summary.is_some() && !loaded.has_errors();
    if file.json {
        output::json(&serde_json::json!({"valid": fine, "problems": loaded.reports(), "files": loaded.files}));
        return if fine { Ok(Exit::Ok) } else { Err(has_mistakes(&file.file)) };
    }
    let Some(summary) = summary.filter(|_| fine) else { return Err(file.refuse(&loaded)) };
    let text = loaded.render(output::colour(&std::io::stderr()));
    if !text.is_empty() {
        output::note(text.trim_end());
    }
    output::line(summary);
    output::line(output::no_mistakes(loaded.warnings()));
    Ok(Exit::Ok)
}

/// Warns of links that touch in every configuration: a planner cannot check them against each other.
fn touching_links(robot: RobotModel, loaded: &mut Loaded) {
    let allowed = loaded.semantics.disabled_pairs().collect();
    // Errors of shapes were reported with the meshes; others appear only here.
    let touching = match always_touching(robot, allowed) {
        Ok(touching) => touching,
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

/// Warns of named poses that the robot cannot take.
fn poses_outside_limits(robot: &RobotModel, loaded: &mut Loaded) {
    for pose in std::mem::take(&mut loaded.semantics.poses) {
        if let Some((joint, q)) = pose.outside(robot) {
            let (unit, limits) = (joint.kind.unit(), joint.limits);
            let what = format!("the pose {} cannot be used: {} at {q} {unit}", quote(&pose.name), quote(&joint.name));
            let hint = format!("its range is {:.4} to {:.4} {unit}", limits.lower, limits.upper);
            loaded.report(Diag::warning(what).at(pose.at.label()).hint(hint));
        }
        loaded.semantics.poses.push(pose);
    }
}
