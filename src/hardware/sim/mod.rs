//! What simulated arms share: a joint plant and a gripper that move, a script of the faults they play, the arm behind
//! an emulated controller, and the server that puts a controller on a wire.

pub mod arm;
pub mod faults;
pub mod gripper;
pub mod plant;
pub mod stream;
pub mod tcp_server;
