//! The simulation kit: what every emulator is made of. An emulator is a device model, which is the controller's side of
//! its own bytes, on these parts:
//!
//! | part | what it is |
//! |---|---|
//! | [`arm`] | [`SimArm`](arm::SimArm): joints with a motor each, modes, error, E-stop line, uptime; its options `sim` |
//! | [`plant`] | how the joints move: limits, lag, droop under load, falling without power, blocked and sagging joints |
//! | [`gripper`] | a gripper with a finite speed |
//! | [`reach`] | poses of the arm's end, and the inverse kinematics |
//! | [`faults`] | the script of faults: what goes wrong, when, how often, for how long |
//! | [`delivery`] | what becomes of an answer or report: late, lost, damaged, cut off, without power |
//! | [`tcp_server`] | one port for requests, or several with clients and reports of their own |
//! | [`serial_server`] | a pseudo-terminal; requests as over TCP ([`stream`]) |
//! | [`can_server`] | a bus in memory, a CAN interface, or a serial CAN adapter; the arm sends by itself |
//! | [`trace`] | what came over the wire, for tests |
//! | [`events`] | clients and faults, as `dimos adapter emulate` shows them |
//!
//! A device model implements [`HasArm`](arm::HasArm) and either [`stream::Controller`] or
//! [`CanController`](can_server::CanController); the server then is the [`Emulator`](super::registry::Emulator). Time
//! is passed in: a device model never asks a clock, and sleeps nowhere. `dimos adapter new` writes a complete one;
//! those of the xArm (several ports), the Piper (CAN, a motor command per joint, no modes, falls) and `remote` (JSON
//! lines) are larger examples.

pub mod arm;
mod can_connection;
pub mod can_server;
pub mod delay;
pub mod delivery;
pub mod events;
pub mod faults;
pub mod gripper;
pub mod options;
pub mod plant;
mod plant_joint;
pub mod reach;
pub mod serial_server;
pub mod stream;
mod tcp_listener;
pub mod tcp_server;
pub mod trace;
