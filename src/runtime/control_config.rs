//! What the coordinator and the log are made from: names and limits of a blueprint, and what its arms said.

use crate::blueprint::Blueprint;
use crate::control::config::{ArmConfig, CONTROL_VERSION, CoordinatorConfig, TaskConfig, TaskKind};
use crate::hardware::device;
use crate::joint::{JointLimits, MAX_DOF};
use crate::telemetry::describe::{ArmNames, Names};

/// Names of arms, joints and tasks, in the order of their indices.
pub(super) fn names_of(blueprint: &Blueprint) -> Names {
    Names {
        arms: blueprint
            .arms
            .iter()
            .map(|a| ArmNames { hardware_id: a.hardware_id.clone(), joints: a.joints.clone() })
            .collect(),
        tasks: blueprint.tasks.iter().map(|t| t.name.clone()).collect(),
    }
}

/// Arms with their effective limits, and tasks.
pub(super) fn coordinator_config(
    blueprint: &Blueprint,
    connected: &[(device::Connected, JointLimits)],
    kinds: Vec<TaskKind>,
) -> CoordinatorConfig {
    let arms = blueprint.arms.iter().zip(connected);
    CoordinatorConfig {
        version: CONTROL_VERSION,
        rate: blueprint.coordinator.tick_rate,
        arms: arms
            .map(|(arm, (said, limits))| ArmConfig {
                name: arm.hardware_id.clone(),
                dof: arm.joints.len().min(MAX_DOF),
                limits: limits.clone(),
                modes: said.info.modes.to_vec(),
                gripper: arm.adapter.gripper,
                own_velocity: said.limits.velocity_max.clone(),
                read_period: said.read_period,
                write_period: said.write_period,
                supervision: arm.supervision,
            })
            .collect(),
        tasks: blueprint
            .tasks
            .iter()
            .zip(kinds)
            .map(|(task, kind)| TaskConfig {
                name: task.name.clone(),
                kind,
                joints: task.joints.iter().map(|&j| j as u16).collect(),
                priority: task.priority,
                auto_start: task.auto_start,
            })
            .collect(),
    }
}
