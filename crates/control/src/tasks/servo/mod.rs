//! `servo`: follows streamed joint positions.

mod body;
mod params;

pub use params::ServoParams;

use crate::task_body::{Demand, TargetKind, TaskBody};
use crate::task_spec::{BuildError, ParamsSpec, TaskSetup, TaskSpec};

/// The row of the table.
pub const SPEC: TaskSpec = TaskSpec {
    name: "servo",
    about: "follows streamed positions",
    params: ParamsSpec::of::<ServoParams>(),
    takes: &[TargetKind::Positions],
    demand: Demand::Positions,
    robot: false,
    build,
};

fn build(setup: &TaskSetup<'_>) -> Result<Box<dyn TaskBody>, BuildError> {
    let params: ServoParams = setup.params()?;
    match &params.default_positions {
        Some(positions) if positions.len() != setup.joints.len() => {
            let what = format!("{} positions for {} joints", positions.len(), setup.joints.len());
            let hint = "give one for each joint of the task, in the same order";
            Err(BuildError::new("default_positions", what).hint(hint))
        }
        _ => Ok(Box::new(body::ServoTask::new(params))),
    }
}
