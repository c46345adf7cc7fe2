//! Grippers: orders, targets that come with streams, and whether something is held.

pub(in crate::runtime) mod go_grips;
pub(in crate::runtime) mod grip_judge;
pub(in crate::runtime) mod gripper_requests;
pub(in crate::runtime) mod gripper_targets;

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

use super::Service;
use dimos_core::sync::lock;
use dimos_rpc::RpcError;
use gripper_requests::LatestGrip;
use gripper_targets::GripperTargets;

/// The grippers of a run. Lists are per arm.
pub(in crate::runtime) struct Grippers {
    /// One order at a time, so that each gets its own answer.
    turns: Vec<tokio::sync::Mutex<()>>,
    latest: Vec<Mutex<LatestGrip>>,
    /// The targets of streams.
    targets: Vec<Mutex<GripperTargets>>,
    /// Whether the last command ended with an object in the grip.
    holding: Vec<AtomicBool>,
    /// Objects of the planner's world that an arm holds, each with its arm.
    attached: Mutex<BTreeMap<String, u16>>,
}

impl Grippers {
    pub fn new(arms: usize) -> Self {
        Self {
            turns: (0..arms).map(|_| tokio::sync::Mutex::default()).collect(),
            latest: (0..arms).map(|_| Mutex::default()).collect(),
            targets: (0..arms).map(|_| Mutex::default()).collect(),
            holding: (0..arms).map(|_| AtomicBool::default()).collect(),
            attached: Mutex::default(),
        }
    }
}

/// What arms hold: one whose gripper is lost with it is held.
impl Service {
    /// Notes whether a command of an arm's gripper ended with an object in the grip.
    pub(in crate::runtime) fn note_grip(&self, arm: usize, holding: bool) {
        if let Some(noted) = self.grippers.holding.get(arm) {
            noted.store(holding, Relaxed);
        }
        self.carry_on(arm);
    }

    /// Notes that a robot of the planner holds an object.
    pub(in crate::runtime) async fn note_attached(&self, object: String, robot: &str) -> Result<(), RpcError> {
        let arms = 0..self.facts.config.arms.len();
        if !arms.into_iter().any(|arm| self.arms.gripper(arm).is_some()) {
            return Ok(());
        }
        if let Some(arm) = self.arm_of_robot(robot).await? {
            lock(&self.grippers.attached).insert(object, arm);
            self.carry_on(arm.into());
        }
        Ok(())
    }

    /// Notes that no robot holds an object.
    pub(in crate::runtime) fn note_detached(&self, object: &str) {
        let arm = lock(&self.grippers.attached).remove(object);
        arm.into_iter().for_each(|arm| self.carry_on(arm.into()));
    }

    /// Passes on whether an arm holds something.
    fn carry_on(&self, arm: usize) {
        let holding = self.grippers.holding.get(arm).is_some_and(|holding| holding.load(Relaxed));
        let attached = lock(&self.grippers.attached).values().any(|holder| usize::from(*holder) == arm);
        if let Some(gripper) = self.arms.gripper(arm) {
            gripper.set_carries(holding || attached);
        }
    }
}
