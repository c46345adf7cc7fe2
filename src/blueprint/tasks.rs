//! Checks `tasks`: names, types, joints, modes, parameters, and shared joints.

use serde_json::Value;

use crate::blueprint::arms::Hardware;
use crate::blueprint::resolve::{Checker, Task};
use crate::blueprint::schema::{JointNames, TaskEntry};
use dimos_control::task_body::TargetKind;
use dimos_control::task_spec::{TaskSetup, TaskSpec};
use dimos_core::joint::{ControlMode, MAX_DOF};
use dimos_yaml::{Diag, Located, NodeId, did_you_mean, quote};

/// The readable part of a task.
struct Checked<'e> {
    entry: &'e Located<TaskEntry>,
    joints: Vec<usize>,
}

pub(super) fn resolve(checker: &mut Checker<'_>, entries: &[Located<TaskEntry>], hardware: &Hardware) -> Vec<Task> {
    let root = checker.root;
    if entries.is_empty() && !checker.list_lost("tasks") {
        let at = checker.tree.entry(root, "tasks").map_or(root, |(key, _)| key);
        let diag = Diag::warning("the blueprint has no task: nothing can move the arms");
        checker
            .error(at, diag.hint("add one: tasks: [{name: traj_arm, type: trajectory, joint_names: {hardware: arm}}]"));
    }
    let mut tasks = Vec::new();
    let mut checked: Vec<Checked<'_>> = Vec::new();
    for entry in entries {
        if checker.has(entry.at, "name") {
            checker.check_name(&entry.name, "task name");
            let named = |c: &&Checked<'_>| c.entry.name.value == entry.name.value;
            if let Some(first) = checked.iter().find(named).map(|c| c.entry.name.at) {
                let also = checker.tree.label(first).with_text("first used here");
                let diag = Diag::error(format!("two tasks are named {}", quote(&entry.name))).also(also);
                checker.error(entry.name.at, diag.hint("give each task its own name"));
            }
        }
        let (joints, arms) = joints(checker, entry, hardware);
        if let Some(spec) = spec(checker, entry) {
            let params = params(checker, entry, &spec, &joints, hardware);
            modes(checker, entry, &spec, &arms, hardware);
            tasks.push(Task {
                name: entry.name.value.clone(),
                spec,
                params,
                joints: joints.clone(),
                arms,
                priority: entry.priority,
                auto_start: entry.auto_start,
                robot: None,
                leader: Vec::new(),
            });
        }
        checked.push(Checked { entry, joints });
    }
    report_sharing(checker, &checked, hardware);
    tasks
}

/// Returns the joints of a task (indices over all arms), and their arms.
fn joints(checker: &mut Checker<'_>, entry: &Located<TaskEntry>, hardware: &Hardware) -> (Vec<usize>, Vec<usize>) {
    let mut joints: Vec<usize> = Vec::new();
    if !checker.has(entry.at, "joint_names") {
        return (joints, Vec::new());
    }
    let all: Vec<(usize, &str)> = hardware
        .entries
        .iter()
        .enumerate()
        .flat_map(|(arm, e)| e.joints.iter().map(move |joint| (arm, joint.as_str())))
        .collect();
    match &entry.joint_names.value {
        JointNames::Hardware(_) if checker.lost.contains(entry.joint_names.at) => {}
        JointNames::Hardware(by_arm) => {
            let id = &by_arm.hardware;
            match hardware.entries.iter().position(|e| e.id == id.value) {
                Some(arm) => joints = (0..all.len()).filter(|i| all.get(*i).is_some_and(|(a, _)| *a == arm)).collect(),
                None if !hardware.ids_known => {}
                None => {
                    let diag = Diag::error(format!("there is no arm {}", quote(id)));
                    let ids = hardware.entries.iter().map(|e| e.id.as_str());
                    let hint = did_you_mean(id, ids, "arms in `hardware`");
                    checker.error(id.at, diag.maybe_hint(hint));
                }
            }
        }
        JointNames::Names(names) => {
            if names.is_empty() && !checker.lost.contains(entry.joint_names.at) {
                let diag = Diag::error("the task has no joints");
                checker.error(entry.joint_names.at, diag.hint("for example `joint_names: {hardware: arm}`"));
            }
            for (number, name) in names.iter().enumerate() {
                if let Some(first) = names.iter().take(number).find(|n| n.value == name.value) {
                    let also = checker.tree.label(first.at).with_text("first named here");
                    let diag = Diag::error(format!("the joint {} is named twice", quote(name))).also(also);
                    checker.error(name.at, diag.hint("remove one of the two"));
                    continue;
                }
                match all.iter().position(|(_, joint)| *joint == name.value) {
                    Some(joint) => joints.push(joint),
                    None if hardware.joints_known => {
                        let diag = Diag::error(format!("no arm has a joint {}", quote(name)));
                        let hint = did_you_mean(name, all.iter().map(|(_, joint)| *joint), "joints");
                        checker.error(name.at, diag.maybe_hint(hint));
                    }
                    None => {}
                }
            }
        }
    }
    let mut arms: Vec<usize> = joints.iter().filter_map(|i| all.get(*i)).map(|(arm, _)| *arm).collect();
    arms.sort_unstable();
    arms.dedup();
    (joints, arms)
}

/// Returns the row of the task's type.
fn spec(checker: &mut Checker<'_>, entry: &Located<TaskEntry>) -> Option<TaskSpec> {
    if !checker.has(entry.at, "type") {
        return None;
    }
    let types = checker.catalog.tasks;
    let found = types.get(&entry.kind).copied();
    if found.is_none() {
        let diag = Diag::error(format!("there is no task type {}", quote(&entry.kind)));
        checker.error(entry.kind.at, diag.maybe_hint(did_you_mean(&entry.kind, types.names(), "there are")));
    }
    found
}

/// Returns the task's parameters, checked by its type.
fn params(
    checker: &mut Checker<'_>,
    entry: &Located<TaskEntry>,
    spec: &TaskSpec,
    joints: &[usize],
    hardware: &Hardware,
) -> Value {
    check_width(checker, entry, spec, joints);
    let node = entry.params.as_ref().filter(|p| !p.value.is_null()).map(|p| p.at);
    let node = node.filter(|_| checker.has(entry.at, "params"));
    let Some(node) = node else { return (spec.params.default)() };
    let (params, lost) = (spec.params.read)(checker.tree, node);
    checker.lost.extend(lost);
    let params = params.unwrap_or_else(spec.params.default);
    let named = checker.has(entry.at, "joint_names") && !checker.lost.contains(entry.joint_names.at);
    if named && hardware.joints_known && !joints.is_empty() && !spec.robot {
        try_build(checker, node, spec, joints, &params);
    }
    params
}

/// Builds the task's body as a run does, to report the mistakes that its type finds. Types that move an end effector
/// are checked in `task_robots`.
fn try_build(checker: &mut Checker<'_>, node: NodeId, spec: &TaskSpec, joints: &[usize], params: &Value) {
    let joints: Vec<u16> = joints.iter().map(|&j| j as u16).collect();
    let Err(error) = (spec.build)(&TaskSetup { joints: &joints, params, robot: None, leader: &[] }) else { return };
    let at = checker.tree.get(node, error.key).unwrap_or(node);
    if !checker.lost.contains(at) {
        checker.error(at, Diag::error(error.what).maybe_hint(error.hint));
    }
}

/// Checks the number of joints of a task with streamed targets, which have a fixed size.
fn check_width(checker: &mut Checker<'_>, entry: &TaskEntry, spec: &TaskSpec, joints: &[usize]) {
    if spec.takes.iter().any(|kind| *kind != TargetKind::Trajectory) && joints.len() > MAX_DOF {
        let kind = spec.name;
        let diag =
            Diag::error(format!("a {kind} task moves at most {MAX_DOF} joints, this one names {}", joints.len()));
        checker.error(entry.joint_names.at, diag.hint("make one task per arm"));
    }
}

/// Checks that every arm of the task has a control mode that the task needs.
fn modes(checker: &mut Checker<'_>, entry: &TaskEntry, spec: &TaskSpec, arms: &[usize], hardware: &Hardware) {
    let wanted = spec.modes();
    for (id, row) in arms.iter().filter_map(|i| hardware.entries.get(*i)).filter_map(|e| Some((&e.id, e.adapter?))) {
        if wanted.is_empty() || row.modes.iter().any(|mode| wanted.contains(mode)) {
            continue;
        }
        let needs = wanted.iter().map(|m| m.name()).collect::<Vec<_>>().join(" or ");
        let has = row.modes.iter().map(|m| m.name()).collect::<Vec<_>>().join(", ");
        let diag = Diag::error(format!("`{}` tasks need the mode {needs}, which arm {} lacks", spec.name, quote(id)));
        let diag = diag.note(format!("its adapter `{}` has: {has}", row.name));
        let can = |m: ControlMode| row.modes.contains(&m);
        let hint = match () {
            () if can(ControlMode::Velocity) => "a `velocity` task would work with this arm",
            () if can(ControlMode::ServoPosition) || can(ControlMode::Position) => {
                "a `servo` or `trajectory` task would work with this arm"
            }
            () => "no task type works with this arm; leave the task out",
        };
        checker.error(entry.kind.at, diag.hint(hint));
    }
}

/// Reports tasks of the same priority with a common joint: their order in the blueprint would decide, which is rarely
/// intended.
fn report_sharing(checker: &mut Checker<'_>, tasks: &[Checked<'_>], hardware: &Hardware) {
    let names: Vec<&str> = hardware.entries.iter().flat_map(|e| e.joints.iter().map(String::as_str)).collect();
    for (number, second) in tasks.iter().enumerate() {
        for first in tasks.iter().take(number) {
            let (a, b) = (&first.entry, &second.entry);
            let known = checker.has(a.at, "priority") && checker.has(b.at, "priority");
            if !known || a.priority != b.priority || a.name.value == b.name.value {
                continue;
            }
            let shared: Vec<usize> = second.joints.iter().copied().filter(|j| first.joints.contains(j)).collect();
            let Some(joint) = shared.first().and_then(|j| names.get(*j)) else { continue };
            let more = if shared.len() > 1 { format!(" and {} more", shared.len() - 1) } else { String::new() };
            let message = format!(
                "tasks {} and {} share the joint `{joint}`{more} at the same priority, {}",
                quote(&a.name),
                quote(&b.name),
                a.priority
            );
            let both = a.auto_start && b.auto_start;
            let diag = if both { Diag::error(message) } else { Diag::warning(message) };
            let diag = diag.note(match both {
                true => "both are started with the run, so one of them would never get its joints",
                false => "when both are active, the one listed first wins",
            });
            let at = checker.tree.get(b.at, "priority").unwrap_or(b.name.at);
            let also = checker.tree.label(checker.tree.get(a.at, "priority").unwrap_or(a.name.at));
            checker.error(
                at,
                diag.also(also.with_text("the other one")).hint("give the more important task a higher priority"),
            );
        }
    }
}
