//! What simulated arms share: a joint plant and a gripper that move, and a script of the faults they play.

pub mod faults;
pub mod gripper;
pub mod plant;
