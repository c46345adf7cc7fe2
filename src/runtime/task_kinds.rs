//! What the tasks of a blueprint are to the coordinator; robots of Cartesian tasks are read and compiled here.

use std::collections::HashMap;

use glamx::DQuat;

use crate::blueprint::{self, Blueprint, TaskRobot};
use crate::control::config::{CartesianParams, Place, ServoParams, TaskKind, TrajectoryParams, VelocityParams};
use crate::robot::kinematics::{Kinematics, frame};
use crate::robot::load;

/// The kinds of all tasks. An error says which task, and what is wrong with its robot's description.
pub fn task_kinds(blueprint: &Blueprint) -> Result<Vec<TaskKind>, String> {
    let kind = |task: &blueprint::Task| kind(task).map_err(|what| format!("task {}: {what}", task.name));
    blueprint.tasks.iter().map(kind).collect()
}

fn kind(task: &blueprint::Task) -> Result<TaskKind, String> {
    use blueprint::TaskKind as Typed;
    Ok(match &task.kind {
        Typed::Trajectory(p) => TaskKind::Trajectory(TrajectoryParams {
            start_position_tolerance: p.start_position_tolerance,
            path_tolerance: p.path_tolerance,
            goal_tolerance: p.goal_tolerance,
            goal_time: p.goal_time,
        }),
        Typed::Servo(p) => {
            TaskKind::Servo(ServoParams { timeout: p.timeout, default_positions: p.default_positions.clone() })
        }
        Typed::Velocity(p) => {
            TaskKind::Velocity(VelocityParams { timeout: p.timeout, zero_on_timeout: p.zero_on_timeout })
        }
        Typed::CartesianIk(p) => TaskKind::CartesianIk(Box::new(cartesian(p, task.robot.as_ref())?)),
        Typed::EefTwist(p) => TaskKind::EefTwist(Box::new(cartesian(p, task.robot.as_ref())?)),
    })
}

fn cartesian(typed: &blueprint::CartesianParams, robot: Option<&TaskRobot>) -> Result<CartesianParams, String> {
    let robot = robot.ok_or("it has no robot")?;
    let model = load(&robot.source).into_model()?;
    let link = |name: &str| model.link_index(name).ok_or_else(|| format!("the model has no link {name:?}"));
    let joint = |name: &String| model.joint_index(name).ok_or_else(|| format!("the model has no joint {name:?}"));
    let joints = robot.joints.iter().map(joint).collect::<Result<Vec<_>, _>>()?;
    let kinematics = Kinematics::new(&model, &joints, &[]).map_err(|e| e.to_string())?;
    let mut params = CartesianParams {
        timeout: typed.timeout,
        max_linear_velocity: typed.max_linear_velocity,
        max_angular_velocity: typed.max_angular_velocity,
        max_linear_acceleration: typed.max_linear_acceleration,
        max_angular_acceleration: typed.max_angular_acceleration,
        max_tracking_error: typed.max_tracking_error,
        ..CartesianParams::new(kinematics, link(&robot.link)?)
    };
    if let Some((base_link, base_pose)) = &robot.base {
        let rest = model.positions(&HashMap::new());
        let base = model.link_poses(&rest).get(link(base_link)?).copied().unwrap_or_default();
        let root = frame(&(base_pose * base.inverse()));
        params.root =
            Place { position: root.translation.to_array(), orientation: DQuat::from_mat3(&root.matrix3).to_array() };
        params.base = DQuat::from_mat3(&frame(&base).matrix3).to_array();
    }
    Ok(params)
}
