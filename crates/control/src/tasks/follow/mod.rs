//! `follow`: follows the measured joints of another arm, the leader, whose motors may be off.

mod body;
mod estimate;
mod params;
mod pursuit;

pub use params::FollowParams;

use crate::task_body::{Demand, TargetKind};
use crate::task_spec::{ParamsSpec, TaskSpec};

/// The row of the table.
pub const SPEC: TaskSpec = TaskSpec {
    name: "follow",
    about: "follows the joints of another arm",
    params: ParamsSpec::of::<FollowParams>(),
    takes: &[TargetKind::Start],
    demand: Demand::Positions,
    robot: false,
    build: |setup| Ok(Box::new(body::FollowTask::new(setup.params()?, setup.leader))),
};
