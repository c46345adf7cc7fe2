//! Checks planning robots against their descriptions, so that `dimos check` finds what would fail in a run: missing
//! files; joints, groups and links that the model lacks; poses outside its limits. Files of assets that are not fetched
//! yet are not checked.

use std::path::Path;

use crate::blueprint::arms::Hardware;
use crate::blueprint::planner::{PlannerEntry, RobotEntry, RobotJoints};
use crate::blueprint::planner_files;
use crate::blueprint::resolve::Checker;
use dimos_core::written::{self, ShapeSpec};
use dimos_planner::planning::scene::config::{ObjectShape, PlannerConfig, RobotConfig, Unplanned};
use dimos_robot::model::{Joint, RobotModel};
use dimos_robot::srdf::Semantics;
use dimos_robot::urdf::VISUAL_NOT_FOUND;
use dimos_robot::{Source, load};
use dimos_yaml::{Diag, Located, NodeId, Report, Severity, did_you_mean, quote};

/// Maximum number of missing visual meshes shown per description; `dimos model check` shows all.
const NOT_SHOWN: usize = 5;

/// The readable part of a robot's description.
pub(super) struct Described {
    model: Option<RobotModel>,
    semantics: Semantics,
    /// The planned joints, each with its node; `None` if they are not known.
    pub(super) joints: Option<Vec<Located<String>>>,
}

impl Described {
    /// Returns the names of the independent joints that are not planned; none if they are not known.
    pub(super) fn unplanned(&self) -> Vec<String> {
        let (Some(model), Some(planned)) = (&self.model, &self.joints) else { return Vec::new() };
        let own = model.independent_joints().into_iter().filter_map(|joint| model.joints.get(joint));
        let is_planned = |name: &String| planned.iter().any(|joint| joint.value == *name);
        own.map(|joint| joint.name.clone()).filter(|name| !is_planned(name)).collect()
    }

    /// Returns whether the model may have an independent joint of this name; yes if it is not known.
    pub(super) fn may_have(&self, name: &str) -> bool {
        let Some(model) = &self.model else { return true };
        model.joint_index(name).and_then(|joint| model.joints.get(joint)).is_some_and(Joint::is_independent)
    }

    /// Returns the names of the model's joints.
    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        self.model.iter().flat_map(|model| &model.joints).map(|joint| joint.name.as_str())
    }
}

/// Reads the descriptions of all robots, and resolves groups of joints.
pub(super) fn read(checker: &mut Checker<'_>, typed: &PlannerEntry) -> Vec<Described> {
    let read = |robot| {
        let (model, semantics) = description(checker, robot);
        let joints = joints(checker, robot, model.as_ref(), &semantics);
        Described { model, semantics, joints }
    };
    typed.robots.iter().map(read).collect()
}

/// Checks robots and objects against their files.
pub(super) fn check(
    checker: &mut Checker<'_>,
    typed: &PlannerEntry,
    described: &[Described],
    config: &PlannerConfig,
    hardware: &Hardware,
) {
    for ((robot, described), resolved) in typed.robots.iter().zip(described).zip(&config.robots) {
        if let Some(model) = &described.model {
            names(checker, robot, described, model);
            exclusions(checker, robot, model);
            shapes(checker, robot, model);
            meshes(checker, robot, model);
            named_poses(checker, robot, described, model);
            gripper_joint(checker, robot, described, model);
            fixed_joints(checker, robot, described, model, resolved);
            if hardware.joints_known && described.joints.is_some() {
                moved_by_nothing(checker, robot, model, resolved);
            }
        }
    }
    for ((_, entry), object) in typed.world.0.iter().zip(&config.objects) {
        if let (ShapeSpec::Mesh(_) | ShapeSpec::Cloud(_), ObjectShape::Mesh(path) | ObjectShape::Cloud(path)) =
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

/// Returns the robot's description if it has no mistakes. Reports its mistakes and warnings.
fn description(checker: &mut Checker<'_>, robot: &Located<RobotEntry>) -> (Option<RobotModel>, Semantics) {
    let lost = |path: &Located<String>| checker.lost.contains(path.at);
    let optional = [&robot.srdf_path, &robot.joint_limits_path];
    let known = checker.has(robot.at, "model_path") && !lost(&robot.model_path);
    if !known || optional.into_iter().flatten().any(lost) {
        return (None, Semantics::default());
    }
    let source = planner_files::source(checker, robot);
    if checker.assets.source_awaited(&source) {
        return (None, Semantics::default());
    }
    let loaded = load(&source);
    let reports = loaded.reports();
    let check = command(&source);
    let (errors, warnings): (Vec<_>, Vec<_>) = reports.iter().partition(|report| report.severity == Severity::Error);
    if let Some(first) = errors.first() {
        let (at, what) = report_position(robot, &source, first);
        let diag = Diag::error(format!("the robot's description cannot be used: {what}"));
        let more = format!("`{check}` shows all mistakes in it");
        checker.error(at, diag.hint(first.hint.clone().unwrap_or(more)));
    }
    // Of a description without its package all are missing; every other warning is shown.
    let mut missing = 0;
    for report in warnings {
        missing += usize::from(report.message.starts_with(VISUAL_NOT_FOUND));
        if missing <= NOT_SHOWN || !report.message.starts_with(VISUAL_NOT_FOUND) {
            let (at, what) = report_position(robot, &source, report);
            checker.error(at, Diag::warning(what).maybe_hint(report.hint.clone()));
        }
    }
    if let Some(more) = missing.checked_sub(NOT_SHOWN).filter(|more| *more > 0) {
        let diag = Diag::warning(format!("{more} more visual meshes of the robot were not found"));
        checker.error(robot.model_path.at, diag.hint(format!("`{check}` shows them all")));
    }
    (loaded.model, loaded.semantics)
}

/// Returns the command that checks a description alone.
fn command(source: &Source) -> String {
    let mut command = format!("dimos model check {}", source.path.display());
    for (option, path) in [("--srdf", &source.srdf), ("--joint-limits", &source.joint_limits)] {
        command += &path.as_ref().map_or(String::new(), |path| format!(" {option} {}", path.display()));
    }
    for (name, folder) in &source.packages {
        command += &format!(" --package {name}={}", folder.display());
    }
    for (name, value) in &source.xacro_args {
        command += &format!(" --xacro-arg {name}:={value}");
    }
    command
}

/// Returns the key of the file with a mistake, and the mistake with its position in that file.
fn report_position(robot: &RobotEntry, source: &Source, report: &Report) -> (NodeId, String) {
    let what = report.placed();
    let named = |path: &&Path| what.starts_with(&format!("{}:", path.display()));
    let others = [(&robot.srdf_path, &source.srdf), (&robot.joint_limits_path, &source.joint_limits)];
    let found = others.into_iter().find(|(_, path)| path.as_deref().as_ref().is_some_and(named));
    (found.and_then(|(key, _)| key.as_ref()).map_or(robot.model_path.at, |key| key.at), what)
}

/// Returns the planned joints, or those of the named group; `None` if they are not known.
fn joints(
    checker: &mut Checker<'_>,
    robot: &Located<RobotEntry>,
    model: Option<&RobotModel>,
    semantics: &Semantics,
) -> Option<Vec<Located<String>>> {
    if !checker.has(robot.at, "joint_names") || checker.lost.contains(robot.joint_names.at) {
        return None;
    }
    let group = match &robot.joint_names.value {
        RobotJoints::Names(names) => return Some(names.clone()),
        RobotJoints::Group(joints) => &joints.group,
    };
    if robot.srdf_path.is_none() {
        let diag = Diag::error(format!("the group {} is not known: the robot has no SRDF", quote(group)));
        checker.error(group.at, diag.hint("set `srdf_path`, or list the joints"));
        return None;
    }
    let model = model?;
    let Some(found) = semantics.group_joints(model, group) else {
        let groups: Vec<&str> = semantics.groups.iter().map(|group| group.name.as_str()).collect();
        let diag = Diag::error(format!("the SRDF has no group {}", quote(group)));
        checker.error(group.at, diag.maybe_hint(did_you_mean(group, groups, "its groups")));
        return None;
    };
    if found.is_empty() {
        let diag = Diag::error(format!("the group {} has no independent joints", quote(group)));
        checker.error(group.at, diag.hint("`dimos model info` with `--srdf` shows the groups and their joints"));
        return None;
    }
    let names = found.into_iter().filter_map(|joint| model.joints.get(joint)).map(|joint| joint.name.clone());
    Some(names.map(|value| Located { at: group.at, value }).collect())
}

/// Checks joint and link names.
fn names(checker: &mut Checker<'_>, robot: &Located<RobotEntry>, described: &Described, model: &RobotModel) {
    let joints: Vec<&str> = model.joints.iter().map(|joint| joint.name.as_str()).collect();
    for (number, name) in described.joints.iter().flatten().enumerate() {
        let diag = match model.joint_index(name).and_then(|index| model.joints.get(index)) {
            None => Diag::error(format!("the model has no joint {}", quote(name))).maybe_hint(did_you_mean(
                name,
                joints.iter().copied(),
                "its joints",
            )),
            Some(joint) if !joint.is_independent() => {
                let why = if joint.is_movable() { "mimics another joint" } else { "is fixed" };
                Diag::error(format!("the joint {} {why}: it cannot be planned", quote(name)))
                    .hint("remove it; a mimic joint moves with its leader")
            }
            Some(_) if described.joints.iter().flatten().take(number).any(|other| other.value == name.value) => {
                Diag::error(format!("the joint {} is named twice", quote(name)))
            }
            Some(_) => continue,
        };
        checker.error(name.at, diag);
    }
    if checker.has(robot.at, "end_effector_link") && !checker.lost.contains(robot.end_effector_link.at) {
        link(checker, robot.end_effector_link.at, &robot.end_effector_link, model);
    }
    if let Some(flange) = robot.flange_link.as_ref().filter(|flange| !checker.lost.contains(flange.at)) {
        link(checker, flange.at, flange, model);
    }
    // If it is not written, the default applies, and a mistake is reported at the robot.
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

/// Checks the gripper's joint: independent, not planned, and its positions within the limits.
fn gripper_joint(checker: &mut Checker<'_>, robot: &RobotEntry, described: &Described, model: &RobotModel) {
    let Some(gripper) = &robot.gripper_joint else { return };
    let found = own_joint(described, model, &gripper.joint, "name the joint that the gripper drives");
    let found = found.and_then(|joint| within(joint, &[gripper.closed, gripper.open]));
    if let Err(diag) = found {
        checker.error(gripper.joint.at, *diag);
    }
}

/// Checks the joints that are said to stay where they are.
fn fixed_joints(
    checker: &mut Checker<'_>,
    robot: &RobotEntry,
    described: &Described,
    model: &RobotModel,
    config: &RobotConfig,
) {
    for (name, at) in &robot.fixed_joints.0 {
        let of_gripper = robot.gripper_joint.as_ref().is_some_and(|gripper| gripper.joint.value == name.value);
        let found = own_joint(described, model, name, "remove it here").and_then(|joint| within(joint, &[at.value]));
        let diag = match (found, config.unplanned.get(&name.value)) {
            (Err(diag), _) => *diag,
            (Ok(()), Some(Unplanned::Measured(ours))) => {
                let what = format!("the joint {} is measured: it is {} of the run", quote(name), quote(ours));
                Diag::error(what).hint("remove it here")
            }
            (Ok(()), _) if of_gripper => {
                Diag::error(format!("the joint {} is the gripper's", quote(name))).hint("remove it here")
            }
            (Ok(()), _) => continue,
        };
        checker.error(name.at, diag);
    }
}

/// Reports a joint between base and tool that nothing plans, measures or fixes: no pose of the tool is known.
fn moved_by_nothing(checker: &mut Checker<'_>, robot: &RobotEntry, model: &RobotModel, config: &RobotConfig) {
    let links = (model.link_index(&robot.base_link), model.link_index(&robot.end_effector_link));
    let (Some(base), Some(tip)) = links else { return };
    let gripper = robot.gripper_joint.as_ref().map(|gripper| &gripper.joint.value);
    let between = model.independent_of(&model.path(base, tip)).into_iter().filter_map(|joint| model.joints.get(joint));
    let known = |name: &String| {
        config.joints.contains(name) || config.unplanned.contains_key(name) || gripper.is_some_and(|own| own == name)
    };
    for joint in between.filter(|joint| !known(&joint.name)) {
        let (name, tip) = (&joint.name, &robot.end_effector_link.value);
        let inside = 0.0_f64.max(joint.limits.lower).min(joint.limits.upper);
        let what = format!("the joint {} moves {}, and nothing plans or measures it", quote(name), quote(tip));
        checker.error(
            robot.end_effector_link.at,
            Diag::error(what).hint(format!(
                "`joint_name_mapping: {{JOINT: {name}}}` with the joint of the run that measures it, or \
             `fixed_joints: {{{name}: {inside}}}` with its position"
            )),
        );
    }
}

/// Returns a joint of the model that is independent and not planned.
fn own_joint<'m>(described: &Described, model: &'m RobotModel, name: &str, hint: &str) -> Result<&'m Joint, Box<Diag>> {
    let planned = described.joints.iter().flatten().any(|joint| joint.value == name);
    match model.joint_index(name).and_then(|index| model.joints.get(index)) {
        None => {
            let what = Diag::error(format!("the model has no joint {}", quote(name)));
            Err(what.maybe_hint(did_you_mean(name, described.names(), "its joints")).into())
        }
        Some(_) if planned => Err(Diag::error(format!("the joint {} is a planned joint", quote(name)))
            .hint(format!("{hint}; it is not one of `joint_names`"))
            .into()),
        Some(joint) if !joint.is_independent() => {
            let why = if joint.is_movable() { "mimics another joint" } else { "is fixed" };
            let what = Diag::error(format!("the joint {} {why}", quote(name)));
            Err(what.hint("name the joint that the others mimic").into())
        }
        Some(joint) => Ok(joint),
    }
}

/// Checks that positions are within a joint's limits.
pub(super) fn within(joint: &Joint, positions: &[f64]) -> Result<(), Box<Diag>> {
    let limits = joint.limits;
    let outside = |q: &&f64| !(limits.lower - 1e-9..=limits.upper + 1e-9).contains(*q);
    let Some(at) = positions.iter().find(outside) else { return Ok(()) };
    let (lower, upper, unit) = (limits.lower, limits.upper, joint.kind.unit());
    Err(Diag::error(format!("{} at {at} {unit} is outside the model's limits", quote(&joint.name)))
        .hint(format!("its range is {lower:.4} to {upper:.4} {unit}"))
        .into())
}

fn exclusions(checker: &mut Checker<'_>, robot: &Located<RobotEntry>, model: &RobotModel) {
    let Some(at) = checker.tree.get(robot.at, "collision_exclusion_pairs") else { return };
    for (a, b) in &robot.collision_exclusion_pairs {
        link(checker, at, a, model);
        link(checker, at, b, model);
    }
}

fn shapes(checker: &mut Checker<'_>, robot: &RobotEntry, model: &RobotModel) {
    for (name, _) in &robot.collision_shapes.0 {
        link(checker, name.at, &name.value, model);
    }
}

fn meshes(checker: &mut Checker<'_>, robot: &Located<RobotEntry>, model: &RobotModel) {
    let Some(at) = checker.tree.get(robot.at, "auto_convert_meshes") else { return };
    if let Some((link, mesh)) = model.collada_collision().filter(|_| !robot.auto_convert_meshes) {
        let (name, uri) = (quote(&link.name), &mesh.uri);
        let what = format!("the collision mesh of the link {name} is a Collada file: {uri}");
        checker
            .error(at, Diag::error(what).hint("set auto_convert_meshes to true, or give the link an STL or OBJ file"));
    }
}

/// Checks that the named poses of blueprint and SRDF are within the limits.
fn named_poses(checker: &mut Checker<'_>, robot: &RobotEntry, described: &Described, model: &RobotModel) {
    let joints: Vec<String> = described.joints.iter().flatten().map(|name| name.value.clone()).collect();
    let outside = |pose: &[f64]| {
        let joint = |name: &String| model.joint_index(name).and_then(|index| model.joints.get(index));
        let mut limits = pose.iter().zip(&joints).filter_map(|(q, name)| Some((*q, name, joint(name)?)));
        limits.find(|(q, _, joint)| !(joint.limits.lower..=joint.limits.upper).contains(q)).map(|(q, name, joint)| {
            let (unit, limits) = (joint.kind.unit(), joint.limits);
            let degrees = written::degrees(q).filter(|_| unit == "rad");
            let range = || format!("its range is {:.4} to {:.4} {unit}", limits.lower, limits.upper);
            let hint = degrees.unwrap_or_else(range);
            (format!("{} at {q} {unit} is outside the model's limits", quote(name)), hint)
        })
    };
    for (_, pose) in &robot.named_poses.0 {
        if let Some((what, hint)) = outside(pose).filter(|_| !checker.lost.contains(pose.at)) {
            checker.error(pose.at, Diag::error(what).hint(hint));
        }
    }
    let Some(srdf) = &robot.srdf_path else { return };
    for (name, pose) in described.semantics.poses_of(&joints) {
        if let Some((what, hint)) = outside(&pose) {
            let diag = Diag::warning(format!("the SRDF's pose {} cannot be used: {what}", quote(name)));
            checker.error(srdf.at, diag.hint(hint));
        }
    }
}
