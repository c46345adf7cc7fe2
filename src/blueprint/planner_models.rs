//! Checks the planner's robots against their descriptions, so that `dimos check` finds what a run would fail at: files
//! that are not there, joints and links that the model does not have, poses outside its limits. What lies in an asset
//! that has not been fetched yet is checked once it has been.

use std::path::Path;

use crate::blueprint::planner::{PlannerConfig as Typed, RobotConfig as TypedRobot, ShapeEntry};
use crate::blueprint::resolve::Checker;
use crate::planning::config::{ObjectShape, PlannerConfig, RobotConfig};
use crate::robot::model::RobotModel;
use crate::robot::{Source, load};
use crate::yaml::{Diag, Located, NodeId, Severity, did_you_mean, quote};

pub(super) fn check(checker: &mut Checker<'_>, typed: &Typed, config: &PlannerConfig) {
    for (robot, config) in typed.robots.iter().zip(&config.robots) {
        let known = checker.has(robot.at, "model_path") && !checker.lost.contains(robot.model_path.at);
        if known && let Some(model) = model(checker, robot, config) {
            names(checker, robot, &model);
            exclusions(checker, robot, &model);
            named_poses(checker, robot, &model);
        }
    }
    for ((_, entry), object) in typed.world.0.iter().zip(&config.objects) {
        if let (ShapeEntry::Mesh(_) | ShapeEntry::Cloud(_), ObjectShape::Mesh(path) | ObjectShape::Cloud(path)) =
            (&entry.shape.value, &object.shape)
            && !checker.assets.awaited(path)
        {
            file(checker, entry.shape.at, path);
        }
    }
}

fn file(checker: &mut Checker<'_>, at: NodeId, path: &Path) {
    if !path.is_file() {
        let diag = Diag::error(format!("there is no file {}", path.display()));
        checker.error(at, diag.hint("paths are relative to the file that names them"));
    }
}

/// The robot's description, where it has no mistakes.
fn model(checker: &mut Checker<'_>, robot: &TypedRobot, config: &RobotConfig) -> Option<RobotModel> {
    let source = Source {
        path: config.model_path.clone(),
        packages: config.packages.clone(),
        xacro_args: config.xacro_args.clone(),
        ..Source::default()
    };
    if checker.assets.source_awaited(&source) {
        return None;
    }
    let loaded = load(&source);
    let first = loaded.reports().into_iter().find(|report| report.severity == Severity::Error);
    if let Some(first) = first {
        let diag = Diag::error(format!("the robot's description cannot be used: {}", first.message));
        let more = format!("`dimos model check {}` shows all that is wrong with it", config.model_path.display());
        checker.error(robot.model_path.at, diag.hint(first.hint.unwrap_or(more)));
    }
    loaded.model
}

/// Joints and links.
fn names(checker: &mut Checker<'_>, robot: &Located<TypedRobot>, model: &RobotModel) {
    let joints: Vec<&str> = model.joints.iter().map(|joint| joint.name.as_str()).collect();
    for name in robot.joint_names.iter().filter(|name| !joints.contains(&name.as_str())) {
        let diag = Diag::error(format!("the model has no joint {}", quote(name)));
        checker.error(name.at, diag.maybe_hint(did_you_mean(name, joints.iter().copied(), "its joints")));
    }
    if checker.has(robot.at, "end_effector_link") && !checker.lost.contains(robot.end_effector_link.at) {
        link(checker, robot.end_effector_link.at, &robot.end_effector_link, model);
    }
    // Where it is not written the default is meant, and the robot itself is the place.
    let base = checker.tree.get(robot.at, "base_link");
    if base.is_none_or(|at| !checker.lost.contains(at)) {
        link(checker, base.unwrap_or(robot.at), &robot.base_link, model);
    }
}

fn link(checker: &mut Checker<'_>, at: NodeId, name: &str, model: &RobotModel) {
    if model.link_index(name).is_none() {
        let diag = Diag::error(format!("the model has no link {}", quote(name)));
        let links = model.links.iter().map(|link| link.name.as_str());
        checker.error(at, diag.maybe_hint(did_you_mean(name, links, "its links")));
    }
}

fn exclusions(checker: &mut Checker<'_>, robot: &Located<TypedRobot>, model: &RobotModel) {
    let Some(at) = checker.tree.get(robot.at, "collision_exclusion_pairs") else { return };
    for (a, b) in &robot.collision_exclusion_pairs {
        link(checker, at, a, model);
        link(checker, at, b, model);
    }
}

fn named_poses(checker: &mut Checker<'_>, robot: &TypedRobot, model: &RobotModel) {
    for (_, pose) in &robot.named_poses.0 {
        for (position, name) in pose.iter().zip(&robot.joint_names.value) {
            let Some(joint) = model.joint_index(name).and_then(|index| model.joints.get(index)) else { continue };
            let (lower, upper) = (joint.limits.lower, joint.limits.upper);
            if !(lower..=upper).contains(position) && !checker.lost.contains(pose.at) {
                let diag = Diag::error(format!("{} at {position} rad is outside the model's limits", quote(name)));
                checker.error(pose.at, diag.hint(format!("it goes from {lower:.4} to {upper:.4} rad")));
            }
        }
    }
}
