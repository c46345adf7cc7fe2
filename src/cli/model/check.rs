//! `dimos model check`: every mistake of a description, its meshes, its SRDF and its limits.

use super::meshes::MeshSizes;
use super::{File, has_mistakes};
use crate::cli::exit::{Exit, Result};
use crate::cli::output;
use crate::planning::planning_scene::{always_touch, whole};
use crate::robot::model::Inertial;
use crate::robot::urdf::Meshes;
use crate::robot::{Loaded, RobotModel};
use crate::yaml::{Diag, Label, quote};

/// Part of the largest moment of inertia that rounded moments may miss the triangle inequality by.
const ROUNDING: f64 = 1e-3;

/// Runs the verb.
pub(super) fn run(file: &File) -> Result {
    let mut loaded = file.load(Meshes::Find);
    let summary = loaded.model.take().map(|robot| {
        let mut meshes = MeshSizes::default();
        let mistakes = meshes.mistakes(&robot, loaded.document.as_ref());
        mistakes.into_iter().for_each(|diag| loaded.report(diag));
        poses_outside_limits(&robot, &mut loaded);
        impossible_inertias(&robot, &mut loaded);
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
    output::line(match loaded.warnings() {
        0 => "no mistakes".to_owned(),
        1 => "no mistakes, 1 warning".to_owned(),
        more => format!("no mistakes, {more} warnings"),
    });
    Ok(Exit::Ok)
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

/// Warns of inertias that no body has: simulators and dynamics libraries reject them.
fn impossible_inertias(robot: &RobotModel, loaded: &mut Loaded) {
    for link in &robot.links {
        let Some(what) = link.inertial.as_ref().and_then(impossible) else { continue };
        let diag = Diag::warning(format!("the inertia of the link {} is impossible: {what}", quote(&link.name)));
        let at = place_of_inertia(loaded, &link.name);
        loaded.report(at.into_iter().fold(diag, Diag::at));
    }
}

/// Returns what makes an inertia impossible: a negative principal moment, or one above the sum of the others.
fn impossible(inertial: &Inertial) -> Option<String> {
    let mut moments = inertial.inertia.symmetric_eigenvalues();
    moments.as_mut_slice().sort_by(f64::total_cmp);
    let [small, middle, large] = [moments.x, moments.y, moments.z];
    let rounding = ROUNDING * large.abs().max(small.abs());
    if small < -rounding {
        return Some(format!("a principal moment is {small:.3e} kg·m²"));
    }
    (small + middle < large - rounding).then(|| {
        format!("its principal moment {large:.3e} kg·m² is above the sum of the others, {:.3e}", small + middle)
    })
}

fn place_of_inertia(loaded: &Loaded, link: &str) -> Option<Label> {
    let root = &loaded.document.as_ref()?.root;
    let mut links = root.named("link").filter(|element| element.attribute("name").is_some_and(|a| a.value == link));
    Some(links.next()?.child("inertial")?.child("inertia")?.at.label())
}
