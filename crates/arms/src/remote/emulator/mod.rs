//! The emulator: the other process and its arm, for `address: sim`, for tests and for other clients of the protocol. An
//! example of a server in other languages, too.

mod controller;
pub mod wire;

use std::time::Duration;

use super::{Options, limits};
use controller::Controller;
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_hardware::adapter::AdapterResult;
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos_hardware::sim::faults::FaultKind;
use dimos_hardware::sim::tcp_server::TcpServer;

/// Without a request for this long, the server stops an arm that was commanded.
const SILENCE_TIMEOUT: Duration = Duration::from_millis(500);
/// Default port.
const PORT: u16 = 7450;

/// The faults that the emulator can play: no damaged bytes, because a local socket delivers none, and no lost power.
pub(super) const PLAYABLE: &[FaultKind] = &[
    FaultKind::Stall,
    FaultKind::Silent,
    FaultKind::Disconnect,
    FaultKind::ErrorCode,
    FaultKind::Estop,
    FaultKind::Nan,
    FaultKind::WrongDof,
    FaultKind::Misread,
    FaultKind::Frozen,
    FaultKind::Sag,
    FaultKind::Blocked,
    FaultKind::Pushed,
    FaultKind::Nudged,
    FaultKind::MotorOff,
    FaultKind::Object,
    FaultKind::GripperBlocked,
];

/// Starts an emulator at `place`, with the `sim` part of the arm's options. It ends when it is dropped.
pub fn start(config: &AdapterConfig, place: &EmulatorAddress) -> AdapterResult<Box<dyn Emulator>> {
    config.check(super::check)?;
    let sim = config.options::<Options>()?.sim;
    let controller = Controller::new(&limits(config.dof), &sim, MonotonicClock.now())?;
    Ok(Box::new(TcpServer::start("remote", controller, place.tcp(PORT)?)?))
}
