//! Requests to follow a trajectory, kept until the tick has answered: a refused one is logged without the points that
//! the tick did not look at, so that a program that asks in vain, again and again, does not fill the disk.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde_json::json;

use crate::clock::Mono;
use crate::trajectory::JointTrajectory;

/// Requests that are kept. The tick answers within a period; what is older lost its answer.
const MAX_KEPT: usize = 64;
/// Points of a refused trajectory that are logged: two make a trajectory, and the tick judges by the first.
const POINTS: usize = 2;

/// A request to follow a trajectory.
#[derive(Debug)]
pub(super) struct Execute {
    pub stamp: Mono,
    pub task: u16,
    pub motion: u64,
    pub trajectory: Arc<JointTrajectory>,
}

impl Execute {
    /// As it was asked.
    pub fn whole(&self) -> String {
        let Self { task, motion, trajectory, .. } = self;
        json!({"execute": {"task": task, "motion": motion, "trajectory": **trajectory}}).to_string()
    }

    /// As much as the tick looked at to refuse it, and how many points are left out.
    pub fn refused(&self) -> String {
        let Self { task, motion, trajectory, .. } = self;
        let points: Vec<_> = trajectory.points.iter().take(POINTS).collect();
        let left_out = trajectory.points.len() - points.len();
        let start = json!({"joint_names": trajectory.joint_names, "points": points});
        json!({"execute": {"task": task, "motion": motion, "trajectory": start, "left_out": left_out}}).to_string()
    }
}

/// Those that the tick has not answered yet, by their ids.
#[derive(Debug, Default)]
pub(super) struct Executes(BTreeMap<u64, Execute>);

impl Executes {
    /// Keeps a request. Gives back one whose answer will not come any more.
    pub fn asked(&mut self, id: u64, execute: Execute) -> Option<(u64, Execute)> {
        self.0.insert(id, execute);
        if self.0.len() > MAX_KEPT { self.0.pop_first() } else { None }
    }

    /// The request that was answered.
    pub fn answered(&mut self, id: u64) -> Option<Execute> {
        self.0.remove(&id)
    }

    /// What is left, in order.
    pub fn into_unanswered(self) -> impl Iterator<Item = (u64, Execute)> {
        self.0.into_iter()
    }
}
