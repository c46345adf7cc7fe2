//! What others wrote is the judge: the vendors' SDKs, and a kernel that has CAN (in a guest).

#[path = "../support/mod.rs"]
mod support;

mod can_kernel;
mod feetech_sdk;
mod franka;
mod franka_sim;
mod lerobot_bus;
mod meshes;
mod physics;
mod piper_kernel;
mod piper_sdk;
mod robotiq;
mod ur_control;
mod ur_rtde;
mod viewer;
mod xarm_proxy;
mod xarm_sdk;
mod xarm_walk;
