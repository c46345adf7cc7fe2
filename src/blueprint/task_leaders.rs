//! Finds the leader of each task that follows another arm, and the leader's joint for each of its own.

use std::collections::BTreeMap;

use serde::Deserialize;

use crate::blueprint::arms::{Entry, Hardware};
use crate::blueprint::resolve::{Checker, Task};
use crate::blueprint::schema::TaskEntry;
use crate::blueprint::task_pos::TaskPos;
use dimos_control::task_leader::{LeaderJoint, LeaderParams};
use dimos_core::arm::Topology;
use dimos_yaml::{Diag, Located, NodeId, did_you_mean, quote};

/// Sets the leader's joints of every task whose type has a leader.
pub(super) fn resolve(
    checker: &mut Checker<'_>,
    entries: &[Located<TaskEntry>],
    tasks: &mut [Task],
    hardware: &Hardware,
) {
    let mut followers: Vec<Follower> = Vec::new();
    for task in tasks.iter_mut().filter(|task| task.spec.has_leader()) {
        let Ok(params) = LeaderParams::deserialize(&task.params) else { continue };
        let Some(entry) = entries.iter().find(|e| e.name.value == task.name) else { continue };
        let known = hardware.joints_known && hardware.ids_known && !task.joints.is_empty();
        let whole = checker.has(entry.at, "params") && checker.has(entry.at, "joint_names");
        if !known || !whole || checker.lost.contains(entry.joint_names.at) {
            continue;
        }
        let node = entry.params.as_ref().map(|params| params.at);
        let lost = |checker: &Checker<'_>, key| node.is_some_and(|node| !checker.has(node, key));
        if ["leader", "joint_map", "scale", "offset", "gripper"].into_iter().any(|key| lost(checker, key)) {
            continue;
        }
        let pos = TaskPos { entry, params: node };
        let Some(leader) = leader(checker, &pos, &params, task, hardware) else { continue };
        joints(checker, &pos, &params, task, leader, hardware);
        if params.gripper {
            check_grippers(checker, &pos, &task.arms, leader, hardware);
        }
        let at = pos.of(checker, "leader");
        followers.push(Follower { task: task.name.clone(), at, arms: task.arms.clone(), leader });
    }
    report_loop(checker, &followers, hardware);
}

/// A task with its leader.
struct Follower {
    task: String,
    /// Position of its `leader`.
    at: NodeId,
    /// The arms that it moves, and the one that leads.
    arms: Vec<usize>,
    leader: usize,
}

/// Returns the arm that leads.
fn leader(
    checker: &mut Checker<'_>,
    pos: &TaskPos<'_>,
    params: &LeaderParams,
    task: &Task,
    hardware: &Hardware,
) -> Option<usize> {
    let ids = || hardware.entries.iter().map(|e| e.id.as_str());
    let Some(id) = &params.leader else {
        let diag = Diag::error(format!("a `{}` task needs a leader", task.spec.name));
        let other = hardware.entries.iter().enumerate().find(|(arm, _)| !task.arms.contains(arm));
        let name = other.map_or("leader", |(_, entry)| entry.id.as_str());
        checker.error(pos.entry.kind.at, diag.hint(format!("name the arm that leads: `params: {{leader: {name}}}`")));
        return None;
    };
    let at = pos.of(checker, "leader");
    let Some(arm) = ids().position(|other| other == id) else {
        let diag = Diag::error(format!("there is no arm {}", quote(id)));
        checker.error(at, diag.maybe_hint(did_you_mean(id, ids(), "arms in `hardware`")));
        return None;
    };
    if task.arms.contains(&arm) {
        let diag = Diag::error(format!("{} cannot follow itself", quote(id)));
        checker.error(at, diag.hint("name another arm, or other joints in `joint_names`"));
        return None;
    }
    Some(arm)
}

/// Sets the leader's joint, scale and offset for each joint of the task.
fn joints(
    checker: &mut Checker<'_>,
    pos: &TaskPos<'_>,
    params: &LeaderParams,
    task: &mut Task,
    leader: usize,
    hardware: &Hardware,
) {
    let names: Vec<&str> = hardware.entries.iter().flat_map(|e| e.joints.iter().map(String::as_str)).collect();
    let own: Vec<&str> = task.joints.iter().filter_map(|j| names.get(*j)).copied().collect();
    let Some(arm) = hardware.entries.get(leader) else { return };
    let mut good = known(checker, pos, "joint_map", &params.joint_map, &own);
    good &= known(checker, pos, "scale", &params.scale, &own);
    good &= known(checker, pos, "offset", &params.offset, &own);
    for (name, scale) in params.scale.iter().filter(|(_, scale)| **scale == 0.0 || !scale.is_finite()) {
        let diag = Diag::error(format!("{} cannot follow with a scale of {scale}", quote(name)));
        let at = pos.inner(checker, "scale", name).1;
        checker.error(at, diag.hint("give a factor other than 0; -1 reverses the direction"));
    }
    for (name, offset) in params.offset.iter().filter(|(_, offset)| !offset.is_finite()) {
        let at = pos.inner(checker, "offset", name).1;
        checker.error(at, Diag::error(format!("{offset} is no offset")).hint("give an angle [rad]"));
    }
    if !good {
        return;
    }
    if params.joint_map.is_empty() && arm.joints.len() != own.len() {
        let (count, led) = (own.len(), arm.joints.len());
        let diag = Diag::error(format!("the task has {count} joints, its leader {} {led}", quote(&arm.id)));
        let pair = own.first().zip(arm.joints.first()).map_or(String::new(), |(own, its)| format!("{own}: {its}, …"));
        let at = pos.of(checker, "leader");
        return checker.error(at, diag.hint(format!("say which joint follows which: `joint_map: {{{pair}}}`")));
    }
    for (k, name) in own.iter().enumerate() {
        let Some(joint) = leaders_joint(checker, pos, params, (k, name), arm) else { return };
        let of = |map: &BTreeMap<String, f64>, otherwise| map.get(*name).copied().unwrap_or(otherwise);
        let before: usize = hardware.entries.iter().take(leader).map(|entry| entry.joints.len()).sum();
        let (scale, offset) = (of(&params.scale, 1.0), of(&params.offset, 0.0));
        let endless = turns_without_end(hardware, name);
        task.leader.push(LeaderJoint { joint: (before + joint) as u16, scale, offset, endless });
    }
}

/// Returns whether a joint turns without end.
fn turns_without_end(hardware: &Hardware, name: &str) -> bool {
    hardware.arms.iter().any(|arm| {
        let own = arm.joints.iter().position(|joint| joint == name);
        own.and_then(|own| arm.supervision.topology.get(own)) == Some(&Topology::Endless)
    })
}

/// Checks that the leader and the one arm of the task have grippers.
fn check_grippers(checker: &mut Checker<'_>, pos: &TaskPos<'_>, arms: &[usize], leader: usize, hardware: &Hardware) {
    let at = pos.of(checker, "gripper");
    if arms.len() > 1 {
        let diag = Diag::error("the grippers of several arms cannot follow one");
        return checker.error(at, diag.hint("make one task per arm"));
    }
    let entries = arms.iter().chain([&leader]).filter_map(|arm| hardware.entries.get(*arm));
    let lacks = |entry: &&Entry| hardware.arms.iter().any(|arm| arm.hardware_id == entry.id && !arm.has_gripper());
    if let Some(entry) = { entries }.find(lacks) {
        let diag = Diag::error(format!("{} has no gripper", quote(&entry.id)));
        checker.error(at, diag.hint("leave `gripper` out"));
    }
}

/// Returns the index of the leader's joint that the task's joint number `k` follows, or reports that there is none.
fn leaders_joint(
    checker: &mut Checker<'_>,
    pos: &TaskPos<'_>,
    params: &LeaderParams,
    (k, name): (usize, &str),
    arm: &Entry,
) -> Option<usize> {
    if params.joint_map.is_empty() {
        return Some(k);
    }
    let Some(its) = params.joint_map.get(name) else {
        let diag = Diag::error(format!("{} follows no joint of {}", quote(name), quote(&arm.id)));
        let at = pos.params.and_then(|params| checker.tree.entry(params, "joint_map"));
        let at = at.map_or(pos.entry.kind.at, |(key, _)| key);
        checker.error(at, diag.hint("add it to `joint_map`, or name the joints that follow in `joint_names`"));
        return None;
    };
    let found = arm.joints.iter().position(|joint| joint == its);
    if found.is_none() {
        let diag = Diag::error(format!("the leader {} has no joint {}", quote(&arm.id), quote(its)));
        let hint = did_you_mean(its, arm.joints.iter().map(String::as_str), "its joints");
        let at = pos.inner(checker, "joint_map", name).1;
        checker.error(at, diag.maybe_hint(hint));
    }
    found
}

/// Returns whether all keys of a parameter are joints of the task, or reports those that are not.
fn known<V>(checker: &mut Checker<'_>, pos: &TaskPos<'_>, key: &str, map: &BTreeMap<String, V>, own: &[&str]) -> bool {
    let mut good = true;
    for name in map.keys().filter(|name| !own.contains(&name.as_str())) {
        let diag = Diag::error(format!("the task has no joint {}", quote(name)));
        let at = pos.inner(checker, key, name).0;
        checker.error(at, diag.maybe_hint(did_you_mean(name, own.iter().copied(), "its joints")));
        good = false;
    }
    good
}

/// Reports arms that lead each other in a circle.
fn report_loop(checker: &mut Checker<'_>, followers: &[Follower], hardware: &Hardware) {
    for (number, follower) in followers.iter().enumerate() {
        // The arms that lead this one, directly or through others, by the tasks up to this one.
        let mut above = vec![follower.leader];
        let mut next = 0;
        while let Some(&arm) = above.get(next) {
            next += 1;
            for other in followers.iter().take(number + 1).filter(|other| other.arms.contains(&arm)) {
                if !above.contains(&other.leader) {
                    above.push(other.leader);
                }
            }
        }
        let Some(arm) = follower.arms.iter().find(|arm| above.contains(arm)) else { continue };
        let id = |arm: usize| hardware.entries.get(arm).map_or("", |entry| entry.id.as_str());
        let (own, led) = (quote(id(*arm)), quote(id(follower.leader)));
        let diag = Diag::error(format!("{own} would follow {led}, which follows {own}"));
        let first = followers.iter().take(number).find(|other| other.arms.contains(&follower.leader));
        let diag = match first {
            Some(first) => {
                let label = checker.tree.label(first.at).with_text(format!("the leader of {}", first.task));
                diag.also(label)
            }
            None => diag,
        };
        return checker.error(follower.at, diag.hint("let one of the arms lead only"));
    }
}
