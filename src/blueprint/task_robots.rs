//! Finds the robot of each Cartesian task, in its own parameters or among the planner's robots, and checks it against
//! its description.

use std::collections::BTreeMap;
use std::path::PathBuf;

use nalgebra::Isometry3;
use serde::Deserialize;

use crate::blueprint::arms::Hardware;
use crate::blueprint::planner_files::file;
use crate::blueprint::planner_models::within;
use crate::blueprint::resolve::{Checker, Task, TaskRobot};
use crate::blueprint::schema::TaskEntry;
use crate::blueprint::task_pos::TaskPos;
use dimos_control::task_robot::{FramePose, RobotParams, TaskKinematics};
use dimos_planner::planning::scene::config::{PlannerConfig, RobotConfig};
use dimos_robot::kinematics::Kinematics;
use dimos_robot::model::{Joint, JointKind, RobotModel};
use dimos_robot::{Source, load};
use dimos_yaml::{Diag, Located, Severity, did_you_mean, quote};

/// Sets the robot of every task whose type moves an end effector.
pub(super) fn resolve(
    checker: &mut Checker<'_>,
    entries: &[Located<TaskEntry>],
    tasks: &mut [Task],
    planner: Option<&PlannerConfig>,
    hardware: &Hardware,
) {
    let names: Vec<&str> = hardware.entries.iter().flat_map(|e| e.joints.iter().map(String::as_str)).collect();
    for task in tasks.iter_mut().filter(|task| task.spec.robot) {
        let Ok(params) = RobotParams::deserialize(&task.params) else { continue };
        let Some(entry) = entries.iter().find(|e| e.name.value == task.name) else { continue };
        let known = hardware.joints_known && !task.joints.is_empty() && checker.has(entry.at, "joint_names");
        let whole = checker.has(entry.at, "params") && !checker.lost.contains(entry.joint_names.at);
        let joints: Vec<String> = task.joints.iter().filter_map(|j| names.get(*j)).map(|j| (*j).to_owned()).collect();
        if known && whole {
            let pos = TaskPos { entry, params: entry.params.as_ref().map(|p| p.at) };
            task.robot = robot(checker, &pos, &params, &joints, planner, task.spec.name);
        }
    }
}

fn robot(
    checker: &mut Checker<'_>,
    pos: &TaskPos<'_>,
    params: &RobotParams,
    joints: &[String],
    planner: Option<&PlannerConfig>,
    kind: &str,
) -> Option<TaskRobot> {
    let covers = |robot: &&RobotConfig| joints.iter().all(|j| robot.coordinator_joints.contains(j));
    let planned = planner.and_then(|planner| planner.robots.iter().find(covers));
    let mapped = mapping(checker, pos, params, joints)?;
    let mut robot = match (&params.model_path, planned) {
        (Some(path), _) => TaskRobot {
            source: Source {
                path: file(checker, pos.of(checker, "model_path"), path),
                packages: packages(checker, pos, params),
                xacro_args: params.xacro_args.iter().map(|(name, value)| (name.clone(), value.0.clone())).collect(),
                ..Source::default()
            },
            joints: mapped.unwrap_or_else(|| joints.to_vec()),
            link: String::new(),
            tool: None,
            base: None,
            fixed: BTreeMap::new(),
        },
        (None, Some(planned)) => of_planner(planned, joints, mapped),
        (None, None) => {
            let diag = Diag::error(format!("a `{kind}` task needs a robot description"));
            let hint = "set it: `params: {model_path: builtin:yourarm, end_effector_link: flange, joint_prefix: arm_}`, \
                        or add a robot with these joints to `planner`";
            checker.error(pos.entry.kind.at, diag.hint(hint));
            return None;
        }
    };
    robot.fixed.extend(params.fixed_joints.clone());
    match &params.end_effector_link {
        Some(link) => robot.link.clone_from(link),
        None if params.model_path.is_some() => {
            let diag = Diag::error("the end effector is missing");
            let hint = "name the link to move: `end_effector_link: flange`";
            checker.error(pos.of(checker, "model_path"), diag.hint(hint));
            return None;
        }
        None => {}
    }
    // The tool is on a link: a task with another link moves that link.
    robot.tool = planned.filter(|planned| planned.end_effector_link == robot.link).and_then(|planned| planned.tool);
    check(checker, pos, &robot, joints, planned.filter(|_| params.model_path.is_none()));
    Some(robot)
}

/// Returns a planning robot as the robot of a task.
pub(super) fn of_planner(planned: &RobotConfig, joints: &[String], mapped: Option<Vec<String>>) -> TaskRobot {
    let model_name = |ours: &String| {
        let at = planned.coordinator_joints.iter().position(|j| j == ours);
        at.and_then(|at| planned.joints.get(at)).unwrap_or(ours).clone()
    };
    TaskRobot {
        source: Source {
            path: planned.model_path.clone(),
            packages: planned.packages.clone(),
            xacro_args: planned.xacro_args.clone(),
            ..Source::default()
        },
        joints: mapped.unwrap_or_else(|| joints.iter().map(model_name).collect()),
        link: planned.end_effector_link.clone(),
        tool: None,
        base: Some((planned.base_link.clone(), planned.base_pose)),
        fixed: planned.fixed_joints().map(|(name, at)| (name.to_owned(), at)).collect(),
    }
}

fn packages(checker: &Checker<'_>, pos: &TaskPos<'_>, params: &RobotParams) -> BTreeMap<String, PathBuf> {
    let at = pos.of(checker, "package_paths");
    params.package_paths.iter().map(|(name, path)| (name.clone(), file(checker, at, path))).collect()
}

/// Returns the model's names of the task's joints if the parameters map them; the outer `None` follows an error.
fn mapping(
    checker: &mut Checker<'_>,
    pos: &TaskPos<'_>,
    params: &RobotParams,
    joints: &[String],
) -> Option<Option<Vec<String>>> {
    let (prefix, mapping) = (&params.joint_prefix, &params.joint_name_mapping);
    if prefix.is_none() && mapping.is_empty() {
        return Some(None);
    }
    if let Some(odd) = mapping.keys().find(|ours| !joints.contains(ours)) {
        let diag = Diag::error(format!("the task has no joint {}", quote(odd)));
        let hint = did_you_mean(odd, joints.iter().map(String::as_str), "its joints");
        checker.error(pos.of(checker, "joint_name_mapping"), diag.maybe_hint(hint));
        return None;
    }
    // A joint that is not mapped has the prefix.
    let prefix = prefix.as_deref().unwrap_or_default();
    let name = |ours: &String| mapping.get(ours).cloned().or_else(|| Some(ours.strip_prefix(prefix)?.to_owned()));
    let named: Result<Vec<String>, &String> = joints.iter().map(|ours| name(ours).ok_or(ours)).collect();
    match named {
        Ok(named) => Some(Some(named)),
        Err(odd) => {
            let diag = Diag::error(format!("the joint {} does not begin with {}", quote(odd), quote(prefix)));
            let hint = "`joint_prefix` and the model's name make the coordinator's joint name";
            checker.error(pos.of(checker, "joint_prefix"), diag.hint(hint));
            None
        }
    }
}

/// Checks a task's robot against its description.
fn check(
    checker: &mut Checker<'_>,
    pos: &TaskPos<'_>,
    robot: &TaskRobot,
    ours: &[String],
    planned: Option<&RobotConfig>,
) {
    if checker.assets.source_awaited(&robot.source) {
        return;
    }
    let loaded = load(&robot.source);
    let first = loaded.reports().into_iter().find(|report| report.severity == Severity::Error);
    // A mistake in a planning robot is reported in its section.
    if let Some(first) = first.filter(|_| robot.base.is_none()) {
        let diag = Diag::error(format!("the robot's description cannot be used: {}", first.message));
        let more = format!("`dimos model check {}` shows all mistakes in it", robot.source.path.display());
        checker.error(pos.of(checker, "model_path"), diag.hint(first.hint.unwrap_or(more)));
    }
    let Some(model) = loaded.model else { return };
    let at = ["joint_name_mapping", "joint_prefix", "model_path"].into_iter();
    let at = at.map(|key| pos.of(checker, key)).find(|at| *at != pos.entry.kind.at).unwrap_or(pos.entry.kind.at);
    let mut good = true;
    for (name, ours) in robot.joints.iter().zip(ours) {
        let joint = model.joint_index(name).and_then(|j| model.joints.get(j));
        let diag = match joint {
            Some(joint) if joint.is_independent() => continue,
            Some(_) => Diag::error(format!("the model's joint {} is not independent", quote(name))),
            None => {
                let names = model.joints.iter().filter(|j| j.kind != JointKind::Fixed).map(|j| j.name.as_str());
                let diag = Diag::error(format!("the model has no joint {}, for {}", quote(name), quote(ours)));
                diag.maybe_hint(did_you_mean(name, names, "its joints"))
            }
        };
        checker.error(at, diag);
        good = false;
        break;
    }
    let Some(link) = model.link_index(&robot.link) else {
        let diag = Diag::error(format!("the model has no link {}", quote(&robot.link)));
        let links = model.links.iter().map(|link| link.name.as_str());
        let hint = did_you_mean(&robot.link, links, "its links");
        return checker.error(pos.of(checker, "end_effector_link"), diag.maybe_hint(hint));
    };
    if good {
        check_chain(checker, pos, robot, (&model, link), planned);
    }
}

/// Checks that the task's joints move the end effector, and that all others on the way to it stay where they are known
/// to be: a task does not follow them.
fn check_chain(
    checker: &mut Checker<'_>,
    pos: &TaskPos<'_>,
    robot: &TaskRobot,
    (model, link): (&RobotModel, usize),
    planned: Option<&RobotConfig>,
) {
    let base = robot.base.as_ref().and_then(|(base, _)| model.link_index(base)).unwrap_or(0);
    let between = model.independent_of(&model.path(base, link));
    let between: Vec<&Joint> = between.into_iter().filter_map(|joint| model.joints.get(joint)).collect();
    if !between.iter().any(|joint| robot.joints.contains(&joint.name)) {
        let diag = Diag::error(format!("no joint of the task moves the link {}", quote(&robot.link)));
        let at = pos.of(checker, "end_effector_link");
        return checker.error(at, diag.hint("name a link below the task's joints"));
    }
    let known = |name: &String| robot.joints.contains(name) || robot.fixed.contains_key(name);
    if let Some(other) = between.iter().find(|joint| !known(&joint.name)) {
        let name = &other.name;
        let what = format!("the joint {} moves the end effector but is not a joint of the task", quote(name));
        let gripper = planned.and_then(|planned| planned.gripper_joint.as_ref());
        let follows = gripper.is_some_and(|own| own.joint == *name)
            || planned.is_some_and(|planned| planned.unplanned.contains_key(name));
        let hint = format!("`params: {{fixed_joints: {{{name}: POSITION}}}}` with where it is while the task runs");
        let diag = match follows {
            true => Diag::error(what).note("the planner follows it where it is measured; a task does not").hint(hint),
            false => Diag::error(what).hint(format!("add it to the task's joints, or {hint}")),
        };
        checker.error(pos.entry.joint_names.at, diag);
    }
    for (name, at) in &robot.fixed {
        let joint = model.joint_index(name).and_then(|joint| model.joints.get(joint));
        let wrong = match joint.filter(|joint| joint.is_independent() && !robot.joints.contains(name)) {
            None => Diag::error(format!("the model has no joint {} that stays where it is", quote(name)))
                .hint("name an independent joint that the task does not move"),
            Some(joint) => match within(joint, &[*at]) {
                Ok(()) => continue,
                Err(diag) => *diag,
            },
        };
        checker.error(pos.of(checker, "fixed_joints"), wrong);
    }
}

/// Base of a planning robot: its base link, and that link's pose in the frame `map`.
pub type Base = (String, Isometry3<f64>);

impl TaskRobot {
    /// Reads the robot's description and compiles it for the tick.
    pub fn kinematics(&self) -> Result<TaskKinematics, String> {
        let model = load(&self.source).into_model()?;
        let link = |name: &str| model.link_index(name).ok_or_else(|| format!("the model has no link {name:?}"));
        let joint = |name: &String| model.joint_index(name).ok_or_else(|| format!("the model has no joint {name:?}"));
        let joints = self.joints.iter().map(joint).collect::<Result<Vec<_>, _>>()?;
        let fixed = self.fixed.iter().map(|(name, at)| (name.clone(), *at)).collect();
        let rest = model.positions(&fixed);
        let kinematics = Kinematics::new(&model, &joints, &rest).map_err(|e| e.to_string())?;
        let mut robot = TaskKinematics::new(kinematics, link(&self.link)?);
        robot.tool = self.tool.as_ref().map_or(FramePose::SAME, FramePose::from);
        if let Some((base_link, base_pose)) = &self.base {
            let base = model.link_poses(&rest).get(link(base_link)?).copied().unwrap_or_default();
            robot.root = FramePose::from(&(base_pose * base.inverse()));
            robot.base = base.rotation.coords.into();
        }
        Ok(robot)
    }
}
