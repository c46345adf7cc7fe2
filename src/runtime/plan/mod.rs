//! Planning: its requests, the planner in this process or another, the world, poses, and paths that are checked again.

pub(in crate::runtime) mod attached;
pub(in crate::runtime) mod goal_frames;
pub(in crate::runtime) mod guard_worlds;
pub(in crate::runtime) mod model_requests;
pub(in crate::runtime) mod plan_requests;
pub(in crate::runtime) mod planner_link;
pub(in crate::runtime) mod planner_port;
pub(in crate::runtime) mod recheck;
pub(in crate::runtime) mod saved_poses;
pub(in crate::runtime) mod world_requests;
