//! `trajectory`: executes trajectories.

mod body;
mod params;

pub use params::TrajectoryParams;

use crate::task_body::{Demand, TargetKind};
use crate::task_spec::{ParamsSpec, TaskSpec};

/// The row of the table.
pub const SPEC: TaskSpec = TaskSpec {
    name: "trajectory",
    about: "executes trajectories",
    params: ParamsSpec::of::<TrajectoryParams>(),
    takes: &[TargetKind::Trajectory],
    demand: Demand::Positions,
    robot: false,
    build: |setup| Ok(Box::new(body::TrajectoryTask::new(setup.params()?, setup.joints.len()))),
};
