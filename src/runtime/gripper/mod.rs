//! Grippers: orders, targets that come with streams, and whether something is held.

pub(in crate::runtime) mod go_grips;
pub(in crate::runtime) mod grip_judge;
pub(in crate::runtime) mod gripper_requests;
pub(in crate::runtime) mod gripper_targets;
