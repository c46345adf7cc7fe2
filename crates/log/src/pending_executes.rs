//! Trajectory requests waiting for the tick's answer. A rejected one is logged without the points that the tick did not
//! check, so that a client that retries forever does not fill the disk.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde_json::json;

use dimos_core::clock::Mono;
use dimos_core::telemetry::Origin;
use dimos_core::trajectory::JointTrajectory;
use dimos_core::until::Until;

/// Maximum number of pending requests. The tick answers within a period; an older one has lost its answer.
const MAX_PENDING: usize = 64;
/// Points logged of a rejected trajectory: two make a trajectory, and the tick decides by the first.
const REJECTED_POINTS: usize = 2;

/// A trajectory request.
#[derive(Debug)]
pub(super) struct Execute {
    pub stamp: Mono,
    pub origin: Option<Origin>,
    pub task: u16,
    pub motion: u64,
    pub trajectory: Arc<JointTrajectory>,
    pub until: Option<Until>,
}

impl Execute {
    /// Returns the request as received.
    pub fn whole(&self) -> String {
        let Self { task, motion, trajectory, until, .. } = self;
        let mut execute = json!({"task": task, "motion": motion, "trajectory": **trajectory});
        if let (Some(until), Some(fields)) = (until, execute.as_object_mut()) {
            fields.insert("until".into(), json!(until));
        }
        json!({ "execute": execute }).to_string()
    }

    /// Returns the part that the tick checked, and the number of points left out.
    pub fn refused(&self) -> String {
        let Self { task, motion, trajectory, .. } = self;
        let points: Vec<_> = trajectory.points.iter().take(REJECTED_POINTS).collect();
        let left_out = trajectory.points.len() - points.len();
        let start = json!({"joint_names": trajectory.joint_names, "points": points});
        json!({"execute": {"task": task, "motion": motion, "trajectory": start, "left_out": left_out}}).to_string()
    }
}

/// Pending requests by id.
#[derive(Debug, Default)]
pub(super) struct PendingExecutes(BTreeMap<u64, Execute>);

impl PendingExecutes {
    /// Adds a request. Returns one whose answer was lost, if any.
    pub fn asked(&mut self, id: u64, execute: Execute) -> Option<(u64, Execute)> {
        self.0.insert(id, execute);
        if self.0.len() > MAX_PENDING { self.0.pop_first() } else { None }
    }

    /// Removes and returns the answered request.
    pub fn answered(&mut self, id: u64) -> Option<Execute> {
        self.0.remove(&id)
    }

    /// Returns the remaining requests in order.
    pub fn into_unanswered(self) -> impl Iterator<Item = (u64, Execute)> {
        self.0.into_iter()
    }
}
