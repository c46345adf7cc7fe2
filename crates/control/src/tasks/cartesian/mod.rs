//! `cartesian_ik` and `eef_twist`: move an end effector to poses or with twists.

mod body;
mod end_effector;
mod params;

pub use params::CartesianParams;

use crate::task_body::{Demand, TargetKind, TaskBody};
use crate::task_spec::{BuildError, ParamsSpec, TaskSetup, TaskSpec};

/// The row of the table for poses.
pub const CARTESIAN_IK: TaskSpec = TaskSpec {
    name: "cartesian_ik",
    about: "takes the end effector to streamed poses",
    params: ParamsSpec::of::<CartesianParams>(),
    takes: &[TargetKind::Pose],
    demand: Demand::Positions,
    robot: true,
    build,
};

/// The row of the table for twists.
pub const EEF_TWIST: TaskSpec = TaskSpec {
    name: "eef_twist",
    about: "moves the end effector with streamed velocities",
    takes: &[TargetKind::Twist],
    ..CARTESIAN_IK
};

fn build(setup: &TaskSetup<'_>) -> Result<Box<dyn TaskBody>, BuildError> {
    let robot = setup.robot.ok_or_else(|| BuildError::new("model_path", "the robot is missing"))?;
    Ok(Box::new(body::CartesianTask::new(setup.params()?, robot.clone())))
}
