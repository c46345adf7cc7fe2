//! Checks the names and values of `planner` and `view`.

use crate::blueprint::arms::Hardware;
use crate::blueprint::planner::{ObjectEntry, PlannerEntry, PoseEntry, RobotEntry, ViewConfig};
use crate::blueprint::planner_files;
use crate::blueprint::planner_models::Described;
use crate::blueprint::resolve::Checker;
use crate::blueprint::schema::{JointNames, TaskEntry};
use dimos_control::task_body::TargetKind;
use dimos_core::written;
use dimos_planner::planning::scene::config::MAX_OBJECTS;
use dimos_yaml::{Diag, Located, did_you_mean, quote};

pub(super) fn check(
    checker: &mut Checker<'_>,
    planner: &Located<PlannerEntry>,
    described: &[Described],
    view: Option<&Located<ViewConfig>>,
    tasks: &[Located<TaskEntry>],
    hardware: &Hardware,
) {
    if let (Some(view), Some(visualization)) = (view, &planner.visualization) {
        let also = checker.tree.label(view.at).with_text("the same thing");
        let diag = Diag::error("`planner.visualization` and `view` are the same thing, and both are given").also(also);
        let at = checker.tree.entry(planner.at, "visualization").map_or(visualization.at, |(key, _)| key);
        checker.error(at, diag.hint("remove one of the two"));
    }
    if let Err(what) = written::padding(planner.padding) {
        let at = checker.tree.get(planner.at, "padding").unwrap_or(planner.at);
        checker.error(at, Diag::error(what));
    }
    for (number, (robot, described)) in planner.robots.iter().zip(described).enumerate() {
        if checker.has(robot.at, "name") {
            checker.check_name(&robot.name, "robot's name");
            let duplicate = planner.robots.iter().take(number).find(|r| r.name.value == robot.name.value);
            if let Some(duplicate) = duplicate {
                let also = checker.tree.label(duplicate.name.at).with_text("first used here");
                let diag = Diag::error(format!("two robots are named {}", quote(&robot.name))).also(also);
                checker.error(robot.name.at, diag.hint("give each robot its own name"));
            }
        }
        cap(checker, robot, "max_velocity", written::joint_speed(robot.max_velocity));
        cap(checker, robot, "max_acceleration", written::joint_acceleration(robot.max_acceleration));
        pose(checker, &robot.base_pose);
        robot.tool.iter().for_each(|tool| pose(checker, tool));
        let task = task(checker, robot, tasks);
        joints(checker, robot, described, hardware, task);
        named_poses(checker, robot, described);
    }
    for (name, entry) in &planner.world.0 {
        object(checker, name, entry);
    }
    if let Some((beyond, _)) = planner.world.0.get(MAX_OBJECTS) {
        let diag = Diag::error(format!("the world has {} objects (limit {MAX_OBJECTS})", planner.world.0.len()));
        checker.error(beyond.at, diag.hint("describe several by one mesh or point cloud"));
    }
}

/// Reports what is wrong with a cap on the motions of a robot's joints.
fn cap(checker: &mut Checker<'_>, robot: &Located<RobotEntry>, key: &str, valid: Result<(), String>) {
    if let Err(what) = valid {
        let at = checker.tree.get(robot.at, key).unwrap_or(robot.at);
        checker.error(at, Diag::error(what));
    }
}

/// Checks an object of the world: name, pose, sizes.
fn object(checker: &mut Checker<'_>, name: &Located<String>, object: &Located<ObjectEntry>) {
    checker.check_name(name, "object's name");
    pose(checker, &object.pose);
    if let Err(what) = written::padding(object.padding) {
        let at = checker.tree.get(object.at, "padding").unwrap_or(object.at);
        checker.error(at, Diag::error(what));
    }
    if let Err(what) = object.shape.sizes_valid() {
        checker.error(object.shape.at, Diag::error(what).hint("sizes are above 0, in metres"));
    } else if let Some(doubt) = written::doubt(object.shape.sizes()) {
        checker.error(object.shape.at, Diag::warning(doubt));
    }
}

fn pose(checker: &mut Checker<'_>, pose: &Located<PoseEntry>) {
    let at = |checker: &Checker<'_>, key| checker.tree.get(pose.at, key).unwrap_or(pose.at);
    if let Err(what) = pose.xyz.into_iter().try_for_each(written::length) {
        checker.error(at(checker, "xyz"), Diag::error(what));
    } else if let Some(doubt) = written::doubt(&pose.xyz) {
        checker.error(at(checker, "xyz"), Diag::warning(doubt));
    }
    if let Err(what) = pose.rpy.iter().flatten().copied().try_for_each(written::angle) {
        checker.error(at(checker, "rpy"), Diag::error(what));
    }
    if pose.rpy.is_some() && pose.quat.is_some() {
        let diag = Diag::error("`rpy` and `quat` both give the orientation");
        checker.error(pose.at, diag.hint("remove one of the two"));
    }
    if let Some(quat) = pose.quat
        && !(0.99..=1.01).contains(&quat.iter().map(|v| v * v).sum::<f64>().sqrt())
    {
        let at = at(checker, "quat");
        let diag = Diag::error("the quaternion's length is not 1");
        checker.error(at, diag.hint("write [x, y, z, w]; no rotation is [0, 0, 0, 1]"));
    }
}

/// Returns whether a task is of a type that executes trajectories.
fn executes(checker: &Checker<'_>, task: &TaskEntry) -> bool {
    checker.catalog.tasks.get(&task.kind).is_some_and(|row| row.takes(TargetKind::Trajectory))
}

/// Returns the task that executes the robot's motions; reports one that does not exist or cannot execute them.
fn task<'t>(
    checker: &mut Checker<'_>,
    robot: &RobotEntry,
    tasks: &'t [Located<TaskEntry>],
) -> Option<&'t Located<TaskEntry>> {
    let name = robot.coordinator_task_name.as_ref()?;
    let task = tasks.iter().find(|t| t.name.value == name.value);
    let unnamed = tasks.iter().any(|t| !checker.has(t.at, "name"));
    match task {
        Some(task) if checker.has(task.at, "type") && !executes(checker, task) => {
            let also = checker.tree.label(task.kind.at).with_text("its type");
            let diag = Diag::error(format!("the task {} is not a trajectory task", quote(name))).also(also);
            checker.error(name.at, diag.hint("the planner's motions are executed by a task of type `trajectory`"));
            None
        }
        None if !unnamed && !checker.list_lost("tasks") => {
            let names = tasks.iter().map(|t| t.name.as_str());
            let hint = did_you_mean(name, names, "tasks").or_else(|| Some("the blueprint has no tasks".to_owned()));
            checker.error(name.at, Diag::error(format!("there is no task {}", quote(name))).maybe_hint(hint));
            None
        }
        found => found,
    }
}

/// Checks that the robot's joints are joints of the coordinator and of the task.
fn joints(
    checker: &mut Checker<'_>,
    robot: &Located<RobotEntry>,
    described: &Described,
    hardware: &Hardware,
    task: Option<&Located<TaskEntry>>,
) {
    let mapping = &robot.joint_name_mapping;
    let (model, good) = (described.joints.as_deref().unwrap_or_default(), described.joints.is_some());
    if good && model.is_empty() {
        let diag = Diag::error("the robot has no joints");
        checker.error(robot.joint_names.at, diag.hint("list the planned joints by their names in the model"));
    }
    let is_planned = |name: &str| model.iter().any(|joint| joint.value == name);
    for (number, (_, theirs)) in mapping.0.iter().enumerate() {
        if good && !is_planned(theirs) && !described.may_have(theirs) {
            let diag = Diag::error(format!("the model has no independent joint {}", quote(theirs)));
            checker.error(theirs.at, diag.maybe_hint(did_you_mean(theirs, described.names(), "its joints")));
        }
        if let Some((_, other)) = mapping.0.iter().take(number).find(|(_, other)| other.value == theirs.value) {
            let also = checker.tree.label(other.at).with_text("first mapped here");
            let diag = Diag::error(format!("the joint {} is mapped twice", quote(theirs))).also(also);
            checker.error(theirs.at, diag.hint("one joint of the run is one joint of the model"));
        }
    }
    if !good || ["joint_name_mapping", "joint_prefix"].into_iter().any(|key| !checker.has(robot.at, key)) {
        return;
    }
    // Names of the coordinator's joints, each with its node, and whether it is planned.
    let mut wanted: Vec<(Located<String>, bool)> = Vec::new();
    for (ours, theirs) in &mapping.0 {
        wanted.push((ours.clone(), is_planned(theirs)));
    }
    for joint in model.iter().filter(|joint| !mapping.0.iter().any(|(_, theirs)| theirs.value == joint.value)) {
        let at = robot.joint_prefix.as_ref().map_or(joint.at, |prefix| prefix.at);
        wanted.push((Located { at, value: planner_files::coordinator_name(robot, joint) }, true));
    }
    for (number, (name, _)) in wanted.iter().enumerate() {
        if let Some((other, _)) = wanted.iter().take(number).find(|(other, _)| other.value == name.value) {
            let also = checker.tree.label(other.at).with_text("first used here");
            let diag = Diag::error(format!("{} is two joints of the model", quote(name))).also(also);
            checker.error(name.at, diag.hint("one joint of the run is one joint of the model"));
        }
    }
    if !hardware.joints_known {
        return;
    }
    let ours: Vec<&str> = hardware.entries.iter().flat_map(|e| e.joints.iter().map(String::as_str)).collect();
    let known = |t: &&Located<TaskEntry>| checker.has(t.at, "joint_names") && !checker.lost.contains(t.joint_names.at);
    let of_task = task.filter(known).map(|t| match &t.joint_names.value {
        JointNames::Names(names) => names.iter().map(|n| n.value.clone()).collect::<Vec<_>>(),
        JointNames::Hardware(arm) => {
            hardware.entries.iter().filter(|e| e.id == arm.hardware.value).flat_map(|e| e.joints.clone()).collect()
        }
    });
    let mut reported = Vec::new();
    for (name, planned) in &wanted {
        if reported.contains(&name.at) {
            continue;
        }
        if !ours.contains(&name.as_str()) {
            reported.push(name.at);
            let diag = Diag::error(format!("no arm has a joint {}", quote(name)));
            let (hint, given) = (did_you_mean(name, ours.iter().copied(), "joints"), robot.joint_prefix.is_some());
            let diag = match given {
                true => diag.note("`joint_prefix` and each of `joint_names` make the coordinator's joint names"),
                false => diag,
            };
            checker.error(name.at, diag.maybe_hint(hint));
        } else if let (Some(task), Some(joints)) = (task, &of_task)
            && *planned
            && !joints.is_empty()
            && !joints.contains(&name.value)
        {
            reported.push(name.at);
            let also = checker.tree.label(task.joint_names.at).with_text("the task's joints");
            let diag = Diag::error(format!("the task {} does not command {}", quote(&task.name), quote(name)));
            checker.error(name.at, diag.also(also).hint("add the joint to the task, or name another task"));
        }
    }
}

fn named_poses(checker: &mut Checker<'_>, robot: &Located<RobotEntry>, described: &Described) {
    let Some(count) = described.joints.as_ref().map(Vec::len) else { return };
    for (_, pose) in &robot.named_poses.0 {
        if pose.len() != count && !checker.lost.contains(pose.at) {
            let diag = Diag::error(format!("{} positions for {count} joints", pose.len()));
            checker.error(pose.at, diag.hint("give one for each of `joint_names`, in the same order"));
        }
    }
}
