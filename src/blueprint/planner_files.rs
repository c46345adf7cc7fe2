//! Resolves the section `planner`: full paths, and both names of every joint.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use nalgebra::Isometry3;

use crate::blueprint::arms::Hardware;
use crate::blueprint::planner::{ModelMismatch, ObjectEntry, PlannerEntry, PoseEntry, RobotEntry};
use crate::blueprint::planner_models::Described;
use crate::blueprint::resolve::Checker;
use dimos_core::pose;
use dimos_core::written::ShapeSpec;
use dimos_planner::planning::scene::config::{
    GripperJoint, ObjectConfig, ObjectShape, PlannerConfig, RobotConfig, Unplanned,
};
use dimos_robot::Source;
use dimos_yaml::{Located, NodeId};

/// Returns the configuration of the planner; only valid if nothing was reported.
pub(super) fn resolve(
    checker: &Checker<'_>,
    typed: &PlannerEntry,
    described: &[Described],
    hardware: &Hardware,
) -> PlannerConfig {
    let robots = typed.robots.iter().zip(described);
    PlannerConfig {
        timeout: Duration::from_secs_f64(typed.planning_timeout.clamp(0.0, 86_400.0)),
        padding: typed.padding,
        robots: robots.map(|(robot, described)| self::robot(checker, robot, described, hardware)).collect(),
        objects: typed.world.0.iter().map(|(name, entry)| object(checker, &name.value, entry)).collect(),
        proofs: None,
    }
}

/// Returns the files of a robot's description.
pub(super) fn source(checker: &Checker<'_>, typed: &Located<RobotEntry>) -> Source {
    let path = |path: &Located<String>| file(checker, path.at, path);
    Source {
        path: path(&typed.model_path),
        packages: typed.package_paths.iter().map(|(n, p)| (n.clone(), file(checker, typed.at, p))).collect(),
        xacro_args: typed.xacro_args.iter().map(|(name, value)| (name.clone(), value.0.clone())).collect(),
        srdf: typed.srdf_path.as_ref().map(path),
        joint_limits: typed.joint_limits_path.as_ref().map(path),
        ..Source::default()
    }
}

/// Returns the coordinator's name of a joint of the model, as the robot's entry maps it.
pub(super) fn coordinator_name(typed: &RobotEntry, model: &str) -> String {
    let mapped = typed.joint_name_mapping.0.iter().find(|(_, theirs)| theirs.value == model);
    let prefix = typed.joint_prefix.as_ref().map_or("", |prefix| prefix.as_str());
    mapped.map_or_else(|| format!("{prefix}{model}"), |(ours, _)| ours.value.clone())
}

/// Returns where the joints are that are not planned: as an arm of the run measures them, or fixed.
fn unplanned(typed: &RobotEntry, described: &Described, hardware: &Hardware) -> BTreeMap<String, Unplanned> {
    let gripper = typed.gripper_joint.as_ref().map(|gripper| gripper.joint.as_str());
    let has = |name: &String| hardware.entries.iter().any(|arm| arm.joints.contains(name));
    // A joint of the run is one joint of the model.
    let is_free = |name: &String, joint: &str| {
        let planned = described.joints.iter().flatten().any(|own| coordinator_name(typed, own) == *name);
        let mapped = typed.joint_name_mapping.0.iter().find(|(ours, _)| ours.value == *name);
        !planned && mapped.is_none_or(|(_, theirs)| theirs.value == joint)
    };
    let of = |joint: String| {
        let fixed = || typed.fixed_joints.0.iter().find(|(name, _)| name.value == joint).map(|(_, at)| at.value);
        let names = [coordinator_name(typed, &joint), joint.clone()].into_iter();
        let measured = { names }.find(|name| has(name) && is_free(name, &joint));
        Some((joint.clone(), measured.map(Unplanned::Measured).or_else(|| fixed().map(Unplanned::Fixed))?))
    };
    described.unplanned().into_iter().filter(|joint| gripper != Some(joint.as_str())).filter_map(of).collect()
}

fn robot(
    checker: &Checker<'_>,
    typed: &Located<RobotEntry>,
    described: &Described,
    hardware: &Hardware,
) -> RobotConfig {
    let mut joints: Vec<(usize, String)> =
        described.joints.iter().flatten().map(|name| &name.value).cloned().enumerate().collect();
    // Everywhere in the order of the arm: one list of positions means the same to `move`, with and without a plan.
    let all: Vec<&String> = hardware.entries.iter().flat_map(|arm| &arm.joints).collect();
    joints.sort_by_key(|(_, model)| {
        let ours = coordinator_name(typed, model);
        all.iter().position(|joint| **joint == ours).unwrap_or(usize::MAX)
    });
    let (order, joints): (Vec<usize>, Vec<String>) = joints.into_iter().unzip();
    let source = source(checker, typed);
    RobotConfig {
        name: typed.name.value.clone(),
        model_path: source.path,
        packages: source.packages,
        xacro_args: source.xacro_args,
        srdf: source.srdf,
        joint_limits: source.joint_limits,
        places: source.places,
        shapes: typed.collision_shapes.0.iter().map(|(link, mode)| (link.value.clone(), mode.value)).collect(),
        convert_meshes: typed.auto_convert_meshes,
        base_pose: isometry(&typed.base_pose),
        base_link: typed.base_link.clone(),
        end_effector_link: typed.end_effector_link.value.clone(),
        tool: typed.tool.as_ref().map(|tool| isometry(tool)),
        flange_link: typed.flange_link.as_ref().map(|link| link.value.clone()),
        controller_base: None,
        allows_mismatch: typed.model_mismatch == ModelMismatch::Allow,
        coordinator_joints: joints.iter().map(|joint| coordinator_name(typed, joint)).collect(),
        joints,
        unplanned: unplanned(typed, described, hardware),
        gripper_joint: typed.gripper_joint.as_ref().map(|gripper| GripperJoint {
            joint: gripper.joint.value.clone(),
            closed: gripper.closed,
            open: gripper.open,
        }),
        task: typed.coordinator_task_name.as_ref().map(|name| name.value.clone()),
        exclusions: typed.collision_exclusion_pairs.clone(),
        max_velocity: typed.max_velocity,
        max_acceleration: typed.max_acceleration,
        max_jerk: typed.max_jerk,
        named_poses: typed
            .named_poses
            .0
            .iter()
            .map(|(n, p)| (n.value.clone(), order.iter().filter_map(|at| p.get(*at)).copied().collect()))
            .collect::<BTreeMap<_, _>>(),
    }
}

fn object(checker: &Checker<'_>, name: &str, entry: &Located<ObjectEntry>) -> ObjectConfig {
    let shape = match &entry.shape.value {
        ShapeSpec::Box(size) => ObjectShape::Box(*size),
        ShapeSpec::Sphere(radius) => ObjectShape::Sphere(*radius),
        ShapeSpec::Cylinder(size) => ObjectShape::Cylinder(*size),
        ShapeSpec::Mesh(path) => ObjectShape::Mesh(file(checker, entry.shape.at, path)),
        ShapeSpec::Cloud(path) => ObjectShape::Cloud(file(checker, entry.shape.at, path)),
    };
    ObjectConfig { name: name.to_owned(), shape, pose: isometry(&entry.pose), padding: entry.padding }
}

/// Returns a path into an asset, or a path relative to the file that names it; relative to the working directory if
/// that file is built-in.
pub(super) fn file(checker: &Checker<'_>, at: NodeId, path: &str) -> PathBuf {
    if path.starts_with(dimos_robot::builtin::PREFIX) {
        return path.into();
    }
    if let Some(path) = checker.assets.path(path) {
        return path;
    }
    let source = checker.tree.source(checker.tree.label(at).source).map(|source| Path::new(&source.name));
    let folder = source.filter(|file| file.is_file()).and_then(Path::parent);
    folder.unwrap_or(Path::new("")).join(path)
}

fn isometry(entry: &PoseEntry) -> Isometry3<f64> {
    pose::from_written(entry.xyz, entry.quat, entry.rpy)
}
