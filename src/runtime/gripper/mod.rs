//! Grippers: orders, targets that come with streams, and whether something is held.

pub(in crate::runtime) mod go_grips;
pub(in crate::runtime) mod grip_judge;
pub(in crate::runtime) mod gripper_requests;
pub(in crate::runtime) mod gripper_targets;

use std::sync::Mutex;

use gripper_requests::LatestGrip;
use gripper_targets::GripperTargets;

/// The grippers of a run. Lists are per arm.
pub(in crate::runtime) struct Grippers {
    /// One order at a time, so that each gets its own answer.
    turns: Vec<tokio::sync::Mutex<()>>,
    latest: Vec<Mutex<LatestGrip>>,
    /// The targets of streams.
    targets: Vec<Mutex<GripperTargets>>,
}

impl Grippers {
    pub fn new(arms: usize) -> Self {
        Self {
            turns: (0..arms).map(|_| tokio::sync::Mutex::default()).collect(),
            latest: (0..arms).map(|_| Mutex::default()).collect(),
            targets: (0..arms).map(|_| Mutex::default()).collect(),
        }
    }
}
