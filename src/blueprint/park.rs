//! Checks `on_exit: park` and `park_pose`: where an arm goes at the end of a run.

use crate::blueprint::arms::Hardware;
use crate::blueprint::limits::JointOverride;
use crate::blueprint::resolve::{Checker, Task};
use crate::blueprint::schema::{HardwareEntry, OnExit};
use dimos_control::task_body::TargetKind;
use dimos_core::joint::{JointLimits, POSITION_MARGIN};
use dimos_yaml::{Diag, Located, Severity, quote};

/// Checks the pose of an arm; returns it with `on_exit: park`, otherwise nothing.
pub(super) fn resolve(
    checker: &mut Checker<'_>,
    entry: &Located<HardwareEntry>,
    joints: &[String],
    joints_known: bool,
    own: Option<&JointLimits>,
    limits: &[JointOverride],
) -> Vec<f64> {
    let parks = entry.on_exit == Some(OnExit::Park);
    let Some(pose) = &entry.park_pose else {
        if parks && checker.has(entry.at, "park_pose") {
            let at = checker.tree.entry(entry.at, "on_exit").map_or(entry.at, |(_, value)| value);
            let diag = Diag::error("`on_exit: park` needs a pose");
            let zeros = vec!["0"; joints.len().max(1)].join(", ");
            checker.error(at, diag.hint(format!("add `park_pose: [{zeros}]`, one position [rad] per joint")));
        }
        return Vec::new();
    };
    if !parks {
        if checker.has(entry.at, "on_exit") {
            let diag = Diag::warning("`park_pose` has no effect without `on_exit: park`");
            checker.error(pose.at, diag.hint("add `on_exit: park`, or remove the pose"));
        }
        return Vec::new();
    }
    let damaged =
        checker.tree.is_damaged(pose.at) || checker.tree.items(pose.at).iter().any(|i| checker.lost.dropped(*i));
    if joints_known && !damaged && pose.value.len() != joints.len() {
        let diag = Diag::error(format!("the pose has {} positions, the arm {} joints", pose.value.len(), joints.len()));
        checker.error(pose.at, diag.hint("give one position [rad] per joint, from the base"));
    }
    for (j, (value, joint)) in pose.value.iter().zip(joints).enumerate() {
        let given = limits.get(j).copied().unwrap_or_default();
        let of = |list: fn(&JointLimits) -> &Vec<f64>| own.and_then(|own| list(own).get(j).copied());
        let lower = given.position_lower.or(of(|own| &own.position_lower));
        let upper = given.position_upper.or(of(|own| &own.position_upper));
        let (Some(lower), Some(upper)) = (lower, upper) else { continue };
        if !(lower + POSITION_MARGIN..=upper - POSITION_MARGIN).contains(&value.value) {
            let what =
                format!("{} would park at {} rad, outside its range {lower} to {upper} rad", quote(joint), value.value);
            let diag = Diag::error(what).hint(format!("commands stay {POSITION_MARGIN} rad inside the range"));
            checker.error(value.at, diag);
        }
    }
    pose.value.iter().map(|value| value.value).collect()
}

/// Checks that a trajectory task can take each arm that parks to its pose.
pub(super) fn check_tasks(
    checker: &mut Checker<'_>,
    entries: &[Located<HardwareEntry>],
    tasks: &[Task],
    hardware: &Hardware,
) {
    // A task with a mistake may be the one.
    if checker.list_lost("tasks") || checker.tree.diags().iter().any(|diag| diag.severity == Severity::Error) {
        return;
    }
    let (mut first, mut taken) = (0, Vec::new());
    for (entry, arm) in entries.iter().zip(&hardware.entries) {
        let joints = first..first + arm.joints.len();
        first = joints.end;
        let fits = |task: &Task| {
            task.spec.takes(TargetKind::Trajectory) && joints.clone().all(|joint| task.joints.contains(&joint))
        };
        if entry.on_exit != Some(OnExit::Park) {
            continue;
        }
        let at = checker.tree.entry(entry.at, "on_exit").map_or(entry.at, |(_, value)| value);
        // As at the end of a run: the task with the fewest joints.
        let choice = tasks.iter().enumerate().filter(|(_, task)| fits(task)).min_by_key(|(_, task)| task.joints.len());
        if let Some((task, _)) = choice {
            if taken.contains(&task) {
                let diag = Diag::error(format!("the task that can park {} parks another arm", quote(&arm.id)));
                checker.error(at, diag.hint("add a trajectory task of this arm alone"));
            }
            taken.push(task);
            continue;
        }
        let diag = Diag::error(format!("no trajectory task can park {}", quote(&arm.id)));
        let hint = format!(
            "add one: tasks: [{{name: traj_{id}, type: trajectory, joint_names: {{hardware: {id}}}}}]",
            id = arm.id
        );
        checker.error(at, diag.hint(hint));
    }
}
