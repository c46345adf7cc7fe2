//! The coordinator's configuration: names and limits of a blueprint, and what its arms report.

use crate::blueprint::Blueprint;
use crate::runtime::StartError;
use dimos_control::config::{
    ArmConfig, CONFIG_VERSION, CoordinatorConfig, EffortConfig, TaskConfig, TaskKind, ToolLimit,
};
use dimos_control::task::Task;
use dimos_control::task_spec::{TaskSpec, TaskTable};
use dimos_core::joint::{JointLimits, MAX_DOF};
use dimos_core::telemetry::describe::{ArmNames, Names};
use dimos_hardware::device;

/// Returns the names of arms, joints and tasks, in the order of their indices.
pub(in crate::runtime) fn names_of(blueprint: &Blueprint) -> Names {
    Names {
        arms: blueprint
            .arms
            .iter()
            .map(|a| ArmNames { hardware_id: a.hardware_id.clone(), joints: a.joints.clone() })
            .collect(),
        tasks: blueprint.tasks.iter().map(|t| t.name.clone()).collect(),
    }
}

/// Returns the blueprint's tasks for the coordinator. Reads the robots of tasks that move an end effector.
pub(in crate::runtime) fn tasks(blueprint: &Blueprint) -> Result<(Vec<TaskConfig>, Vec<Task>), String> {
    let config = |task: &crate::blueprint::Task| -> Result<TaskConfig, String> {
        let robot = task.robot.as_ref().map(|robot| robot.kinematics().map(Box::new)).transpose();
        let robot = robot.map_err(|what| format!("task {}: {what}", task.name))?;
        Ok(TaskConfig {
            name: task.name.clone(),
            kind: TaskKind {
                name: task.spec.name.to_owned(),
                params: task.params.clone(),
                robot,
                leader: task.leader.clone(),
            },
            joints: task.joints.iter().map(|&j| j as u16).collect(),
            priority: task.priority,
            auto_start: task.auto_start,
        })
    };
    let configs = blueprint.tasks.iter().map(config).collect::<Result<Vec<_>, _>>()?;
    let types: Vec<TaskSpec> = blueprint.tasks.iter().map(|task| task.spec).collect();
    let tasks = TaskTable::with(&types).build(&configs)?;
    Ok((configs, tasks))
}

/// Returns the speed limits of the arms' tools. An arm whose limit cannot be kept is named in the text log.
pub(in crate::runtime) fn tools(blueprint: &Blueprint) -> Result<Vec<Option<ToolLimit>>, String> {
    let limit = |arm: &crate::blueprint::Arm| {
        let limit = arm.tool_limit().map_err(|what| format!("{}: {what}", arm.hardware_id))?;
        if let (Some(velocity), None) = (arm.tcp_velocity, &limit) {
            let id = &arm.hardware_id;
            tracing::warn!(
                "{id}: no model of it is known, so the {velocity} m/s that its controller allows the tool are not kept"
            );
        }
        Ok(limit)
    };
    blueprint.arms.iter().map(limit).collect()
}

/// Returns what the arms are commanded beside positions. An arm that takes no efforts, as only it knows, is an error.
pub(in crate::runtime) fn efforts(
    blueprint: &Blueprint,
    connected: &[(device::Connected, JointLimits)],
) -> Result<Vec<Option<EffortConfig>>, StartError> {
    let effort = |(arm, (said, _)): (&crate::blueprint::Arm, &(device::Connected, JointLimits))| {
        let id = &arm.hardware_id;
        let objection = said.setpoint.and_then(|fields| fields.effort.objection()).filter(|_| arm.effort.is_some());
        if let Some(objection) = objection {
            let what = format!("the arm takes no efforts ({objection})");
            let hint = format!("remove `feed_forward` and the limits of efforts from `hardware.{id}`");
            return Err(StartError::Hardware { arm: id.clone(), what, hint });
        }
        let config = arm.effort_config(said.impedance.or(arm.setup.impedance));
        config.map_err(|what| {
            let hint = format!("see `hardware.{id}.feed_forward` and `hardware.{id}.model_path`");
            StartError::other(format!("{id}: {what}"), hint)
        })
    };
    blueprint.arms.iter().zip(connected).map(effort).collect()
}

/// Returns the configuration of arms with their effective limits, and of tasks.
pub(in crate::runtime) fn coordinator_config(
    blueprint: &Blueprint,
    connected: &[(device::Connected, JointLimits)],
    tasks: Vec<TaskConfig>,
    (tools, efforts): (Vec<Option<ToolLimit>>, Vec<Option<EffortConfig>>),
) -> CoordinatorConfig {
    let arms = blueprint.arms.iter().zip(connected).zip(tools.into_iter().zip(efforts));
    CoordinatorConfig {
        version: CONFIG_VERSION,
        rate: blueprint.coordinator.tick_rate,
        arms: arms
            .map(|((arm, (said, limits)), (tool, effort))| ArmConfig {
                name: arm.hardware_id.clone(),
                dof: arm.joints.len().min(MAX_DOF),
                limits: limits.clone(),
                modes: said.info.modes.to_vec(),
                gripper: arm.has_gripper(),
                gripper_info: said.gripper.unwrap_or_default(),
                own_velocity: said.limits.velocity_max.clone(),
                read_period: said.read_period,
                write_period: said.write_period,
                supervision: arm.supervision,
                tool: tool.map(Box::new),
                effort: effort.map(Box::new),
            })
            .collect(),
        tasks,
    }
}
