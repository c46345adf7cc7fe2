//! Finds the robot of each Cartesian task, in its own parameters or among the planner's robots, and checks it against
//! its description.

use std::collections::HashMap;
use std::path::PathBuf;

use nalgebra::Isometry3;
use serde::Deserialize;

use crate::blueprint::arms::Hardware;
use crate::blueprint::planner_files::file;
use crate::blueprint::resolve::{Checker, Task, TaskRobot};
use crate::blueprint::schema::TaskEntry;
use crate::blueprint::task_pos::TaskPos;
use crate::control::task_robot::{FramePose, RobotParams, TaskKinematics};
use crate::planning::config::{PlannerConfig, RobotConfig};
use crate::robot::kinematics::Kinematics;
use crate::robot::model::{JointKind, RobotModel};
use crate::robot::{Source, load};
use crate::yaml::{Diag, Located, Severity, did_you_mean, quote};

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
    check(checker, pos, &robot, joints);
    Some(robot)
}

/// Returns a planning robot as the robot of a task.
fn of_planner(planned: &RobotConfig, joints: &[String], mapped: Option<Vec<String>>) -> TaskRobot {
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
    }
}

fn packages(
    checker: &Checker<'_>,
    pos: &TaskPos<'_>,
    params: &RobotParams,
) -> std::collections::BTreeMap<String, PathBuf> {
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
    match prefix {
        Some(_) if !mapping.is_empty() => {
            let at = pos.of(checker, "joint_prefix");
            let diag = Diag::error("`joint_prefix` and `joint_name_mapping` both map the joints' names");
            checker.error(at, diag.hint("remove one of the two"));
            None
        }
        None if mapping.is_empty() => Some(None),
        Some(prefix) => {
            let odd = joints.iter().find(|joint| !joint.starts_with(prefix.as_str()));
            if let Some(odd) = odd {
                let at = pos.of(checker, "joint_prefix");
                let diag = Diag::error(format!("the joint {} does not begin with {}", quote(odd), quote(prefix)));
                checker.error(at, diag.hint("`joint_prefix` and the model's name make the coordinator's joint name"));
                return None;
            }
            Some(Some(joints.iter().map(|j| j.strip_prefix(prefix.as_str()).unwrap_or(j).to_owned()).collect()))
        }
        None => {
            let at = pos.of(checker, "joint_name_mapping");
            if let Some(odd) = mapping.keys().find(|ours| !joints.contains(ours)) {
                let diag = Diag::error(format!("the task has no joint {}", quote(odd)));
                let hint = did_you_mean(odd, joints.iter().map(String::as_str), "its joints");
                checker.error(at, diag.maybe_hint(hint));
                return None;
            }
            Some(Some(joints.iter().map(|ours| mapping.get(ours).unwrap_or(ours).clone()).collect()))
        }
    }
}

/// Checks a task's robot against its description.
fn check(checker: &mut Checker<'_>, pos: &TaskPos<'_>, robot: &TaskRobot, ours: &[String]) {
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
        check_chain(checker, pos, robot, &model, link);
    }
}

/// Checks that the task's joints move the end effector.
fn check_chain(checker: &mut Checker<'_>, pos: &TaskPos<'_>, robot: &TaskRobot, model: &RobotModel, link: usize) {
    let chain = model.chain(0, link).unwrap_or_default();
    let names: Vec<&str> = chain.iter().filter_map(|j| model.joints.get(*j)).map(|j| j.name.as_str()).collect();
    if !robot.joints.iter().any(|j| names.contains(&j.as_str())) {
        let diag = Diag::error(format!("no joint of the task moves the link {}", quote(&robot.link)));
        let at = pos.of(checker, "end_effector_link");
        return checker.error(at, diag.hint("name a link below the task's joints"));
    }
    let independent = chain.iter().filter_map(|j| model.joints.get(*j)).filter(|j| j.is_independent());
    if let Some(other) = { independent }.find(|j| !robot.joints.contains(&j.name)) {
        let what = format!("the joint {} moves the end effector but is not a joint of the task", quote(&other.name));
        let diag = Diag::warning(what).note("the task assumes that it is fixed at 0");
        checker.error(pos.entry.joint_names.at, diag.hint("add it to the task's joints, if the coordinator has it"));
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
        let kinematics = Kinematics::new(&model, &joints, &[]).map_err(|e| e.to_string())?;
        let mut robot = TaskKinematics::new(kinematics, link(&self.link)?);
        robot.tool = self.tool.as_ref().map_or(FramePose::SAME, FramePose::from);
        if let Some((base_link, base_pose)) = &self.base {
            let rest = model.positions(&HashMap::new());
            let base = model.link_poses(&rest).get(link(base_link)?).copied().unwrap_or_default();
            robot.root = FramePose::from(&(base_pose * base.inverse()));
            robot.base = base.rotation.coords.into();
        }
        Ok(robot)
    }
}
