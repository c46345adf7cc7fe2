//! What is at the flange: tools, loads, their speed; and the dimensions that an arm itself has.

pub mod kept_kinematics;
pub mod kinematics;
pub(in crate::runtime) mod payloads;
pub(in crate::runtime) mod tcp;
pub(in crate::runtime) mod tool_requests;
pub(in crate::runtime) mod tool_speed;
