//! The simulation kit for emulators. An emulator is a device model, the controller's side of its protocol, built on
//! these parts:
//!
//! | part | contents |
//! |---|---|
//! | [`arm`] | [`SimArm`](arm::SimArm): joints with a motor each, modes, error, E-stop line, uptime; its options `sim` |
//! | [`plant`] | how the joints move: limits, lag, droop under load, falling without power, blocked and sagging joints |
//! | [`weight`] | masses: joints sag under them, and move by forces in impedance mode |
//! | [`physics`] | a body with mass, friction and contacts behind the arm, by MuJoCo |
//! | [`gripper`] | a gripper with a finite speed |
//! | [`io`] | digital and analogue inputs and outputs |
//! | [`reach`] | end-effector poses and inverse kinematics |
//! | [`faults`] | fault script: what goes wrong, when, how often, for how long |
//! | [`delivery`] | delivery of responses and reports: late, lost, damaged, cut off, without power |
//! | [`tcp_server`] | one port for requests, or several ports with requests, reports or both |
//! | [`peer`] | the user at the other end of a connection within this computer |
//! | [`serial_server`] | a pseudo-terminal; requests as over TCP ([`stream`]) |
//! | [`can_server`] | a bus in memory, a CAN interface, or a serial CAN adapter; the arm streams its state |
//! | [`modbus`] | registers behind Modbus RTU or TCP |
//! | [`peripheral_server`] | a gripper or a sensor with its own connection: on a pseudo-terminal or a TCP port |
//! | [`trace`] | received bytes, for tests |
//! | [`events`] | clients and faults, as `dimos adapter emulate` shows them |
//!
//! A device model implements [`HasArm`](arm::HasArm) and either [`stream::Controller`] or
//! [`CanController`](can_server::CanController); the server then implements [`Emulator`](super::registry::Emulator).
//! Time is passed in: a device model neither reads a clock nor sleeps. `dimos adapter new` writes a complete one.
//! Larger examples are the xArm (several ports), the Piper (CAN, a motor command per joint, no modes, no brakes) and
//! `remote` (JSON lines).

pub mod arm;
mod can_connection;
pub mod can_server;
pub mod delay;
pub mod delivery;
pub mod events;
pub mod faults;
pub mod gripper;
pub mod io;
pub mod misreading;
pub mod modbus;
pub mod options;
pub mod peer;
pub mod peripheral_server;
pub mod physics;
pub mod plant;
mod plant_joint;
pub mod reach;
mod refusal;
pub mod serial_server;
pub mod stream;
mod tcp_listener;
pub mod tcp_server;
mod tcp_session;
pub mod tool_device;
pub mod trace;
pub mod weight;
