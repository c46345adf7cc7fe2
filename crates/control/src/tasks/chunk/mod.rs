//! `chunk`: follows horizons of positions with times, as learned policies make them.

mod blend;
mod body;
mod curve;
mod params;

pub use curve::curve;
pub use params::ChunkParams;

use crate::task_body::{Demand, TargetKind};
use crate::task_spec::{ParamsSpec, TaskSpec};

/// The row of the table.
pub const SPEC: TaskSpec = TaskSpec {
    name: "chunk",
    about: "follows action chunks: positions with times",
    params: ParamsSpec::of::<ChunkParams>(),
    takes: &[TargetKind::Chunk],
    demand: Demand::Positions,
    robot: false,
    build: |setup| Ok(Box::new(body::ChunkTask::new(setup.params()?))),
};
