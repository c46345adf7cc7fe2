//! `velocity`: follows streamed joint velocities.

mod body;
mod params;

pub use params::VelocityParams;

use crate::task_body::{Demand, TargetKind};
use crate::task_spec::{ParamsSpec, TaskSpec};

/// The row of the table.
pub const SPEC: TaskSpec = TaskSpec {
    name: "velocity",
    about: "follows streamed velocities",
    params: ParamsSpec::of::<VelocityParams>(),
    takes: &[TargetKind::Velocities],
    demand: Demand::Velocities,
    robot: false,
    build: |setup| Ok(Box::new(body::VelocityTask::new(setup.params()?))),
};
