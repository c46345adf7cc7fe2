//! The speed limit of an arm's tool, and the model of the arm that it is kept with: a robot of the planner, else that
//! of a Cartesian task, else a built-in one.

use std::collections::BTreeMap;

use crate::blueprint::arms::Hardware;
use crate::blueprint::resolve::{Arm, Checker, Task, TaskRobot};
use crate::blueprint::schema::HardwareEntry;
use crate::blueprint::task_robots::of_planner;
use dimos_control::config::ToolLimit;
use dimos_core::written;
use dimos_planner::planning::scene::config::{PlannerConfig, RobotConfig};
use dimos_robot::builtin::PREFIX;
use dimos_robot::{Source, load};
use dimos_yaml::{Diag, Located};

/// What the speed of an arm's tool is computed with.
#[derive(Debug, Clone, PartialEq)]
pub struct ToolRobot {
    /// The arm's model, its tool centre point, and its joints in the arm's order.
    pub robot: TaskRobot,
    /// Other links that keep the limit, where the model has them.
    pub links: Vec<String>,
}

/// Sets the speed limit of every arm's tool.
pub(super) fn resolve(
    checker: &mut Checker<'_>,
    entries: &[Located<HardwareEntry>],
    hardware: &mut Hardware,
    tasks: &[Task],
    planner: Option<&PlannerConfig>,
) {
    let mut first = 0;
    for arm in &mut hardware.arms {
        let joints: Vec<usize> = (first..first + arm.joints.len()).collect();
        first += arm.joints.len();
        arm.tool_robot = robot(arm, &joints, tasks, planner);
        let given = entries.iter().find(|entry| entry.hardware_id.value == arm.hardware_id);
        let given = given.and_then(|entry| entry.limits.tcp_velocity.as_ref());
        if let Some(given) = given {
            check(checker, arm, given);
        }
        let facts = arm.tool;
        arm.tcp_velocity = match given.map(|given| given.value) {
            Some(given) if facts.is_setting => Some(given),
            Some(given) => Some(facts.velocity.map_or(given, |own| own.min(given))),
            None => facts.velocity,
        };
    }
}

fn check(checker: &mut Checker<'_>, arm: &Arm, given: &Located<f64>) {
    let own = arm.tool.velocity.filter(|own| given.value > *own && !arm.tool.is_setting);
    if !(given.value > 0.0 && given.value.is_finite()) {
        let diag = Diag::error(format!("the tool's speed limit must be above 0, not {}", given.value));
        checker.error(given.at, diag.hint("give it in m/s, or omit it to use the vendor's"));
    } else if let Err(what) = written::tool_speed(given.value) {
        checker.error(given.at, Diag::error(what));
    } else if let Some(own) = own {
        let diag = Diag::error(format!("{} m/s is above the arm's own limit of the tool's speed", given.value));
        let diag = diag.note(format!("the arm's own limit is {own} m/s"));
        checker.error(given.at, diag.hint("limits can only narrow the arm's own; omit this one to use that"));
    } else if arm.tool_robot.is_none() && !checker.incomplete {
        let diag =
            Diag::error(format!("no model of {} is known, so the speed of its tool is not either", arm.hardware_id));
        checker.error(given.at, diag.hint("add a robot with these joints to `planner`, or remove the limit"));
    }
}

fn robot(arm: &Arm, joints: &[usize], tasks: &[Task], planner: Option<&PlannerConfig>) -> Option<ToolRobot> {
    let mut planned = planner.into_iter().flat_map(|planner| &planner.robots);
    let mut links: Vec<String> = arm.tool.also.iter().map(|link| (*link).to_owned()).collect();
    let planned = planned.find(|robot| arm.joints.iter().all(|joint| robot.coordinator_joints.contains(joint)));
    if let Some(planned) = planned {
        links.extend(planned.flange_link.clone());
        return known_robot(arm, joints, tasks, Some(planned)).map(|robot| ToolRobot { robot, links });
    }
    links.extend(arm.tool.model.map(|(_, flange)| flange.to_owned()));
    known_robot(arm, joints, tasks, None).map(|robot| ToolRobot { robot, links })
}

/// Returns the model of an arm that is known: that of its planning robot, of a Cartesian task with its `joints`, or the
/// built-in one.
pub(super) fn known_robot(
    arm: &Arm,
    joints: &[usize],
    tasks: &[Task],
    planned: Option<&RobotConfig>,
) -> Option<TaskRobot> {
    if let Some(planned) = planned {
        return Some(TaskRobot { tool: planned.tool, ..of_planner(planned, &arm.joints, None) });
    }
    let of_task = tasks.iter().filter(|task| task.joints == joints).find_map(|task| task.robot.clone());
    let built_in = || {
        let (name, flange) = arm.tool.model?;
        let source = Source { path: format!("{PREFIX}{name}").into(), ..Source::default() };
        let model = load(&source).into_model().ok()?;
        let chain = model.chain(0, model.link_index(flange)?)?;
        let own = chain.iter().filter_map(|joint| model.joints.get(*joint)).filter(|joint| joint.is_independent());
        let names = own.map(|joint| joint.name.clone()).collect();
        Some(TaskRobot {
            source,
            joints: names,
            link: flange.to_owned(),
            tool: None,
            base: None,
            fixed: BTreeMap::new(),
        })
    };
    of_task.or_else(built_in)
}

impl Arm {
    /// Returns the speed limit of its tool, if it has one and a model of the arm is known. The error names a problem of
    /// that model.
    pub fn tool_limit(&self) -> Result<Option<ToolLimit>, String> {
        let (Some(velocity), Some(tool)) = (self.tcp_velocity, &self.tool_robot) else { return Ok(None) };
        if tool.robot.joints.len() != self.joints.len() {
            return Ok(None);
        }
        let model = load(&tool.robot.source).into_model()?;
        let links = tool.links.iter().filter_map(|name| model.link_index(name)).collect();
        Ok(Some(ToolLimit { velocity, robot: tool.robot.kinematics()?, links }))
    }
}
