//! What simulated arms share: a joint plant and a gripper that move, a script of the faults they play, the arm behind
//! an emulated controller, and the servers that put controllers on wires.

pub mod arm;
pub mod can_server;
pub mod delay;
pub mod diary;
pub mod faults;
pub mod gripper;
pub mod plant;
pub mod serial_server;
pub mod stream;
pub mod tcp_server;
