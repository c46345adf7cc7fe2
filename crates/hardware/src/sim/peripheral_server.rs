//! Emulated peripherals on a pseudo-terminal or a TCP port, and the faults of their wire.

use super::delivery::Delivery;
use super::faults::{DEFAULT_STALL, Fault, FaultKind, FaultScript, check_kind};
use super::serial_server::SerialServer;
use super::stream::Controller;
use super::tcp_server::TcpServer;
use crate::adapter::AdapterResult;
use crate::registry::{Emulator, EmulatorAddress, Truth};
use dimos_core::clock::Mono;

/// The faults of the wire that [`WireFaults`] plays, and that a peripheral has no power.
pub const WIRE_FAULTS: [FaultKind; 7] = [
    FaultKind::Stall,
    FaultKind::Silent,
    FaultKind::Disconnect,
    FaultKind::PowerLoss,
    FaultKind::Garbage,
    FaultKind::Corrupt,
    FaultKind::Truncated,
];

/// An emulated peripheral, as its server needs it.
pub trait Emulated: Controller {
    /// Its faults.
    fn faults(&mut self) -> &mut WireFaults;
    /// What is true of it at `now`.
    fn truth(&mut self, now: Mono) -> Truth;
}

/// The fault script of a peripheral. Times count from its first request.
#[derive(Debug, Clone)]
pub struct WireFaults {
    name: &'static str,
    playable: &'static [FaultKind],
    script: FaultScript,
    first: Option<Mono>,
}

impl WireFaults {
    /// Creates the script of the peripheral `name`, which can play these kinds.
    pub fn new(name: &'static str, playable: &'static [FaultKind], faults: &[Fault]) -> Self {
        Self { name, playable, script: FaultScript::new(faults), first: None }
    }

    /// Notes a request.
    pub fn requested(&mut self, now: Mono) {
        self.first.get_or_insert(now);
    }

    fn time(&self, now: Mono) -> f64 {
        self.first.map_or(0.0, |first| now.seconds_since(first))
    }

    /// Returns the fault of this kind that is due, and counts it as played.
    pub fn take(&mut self, kind: FaultKind, now: Mono) -> Option<Fault> {
        let t = self.time(now);
        self.first.and_then(|_| self.script.take(kind, t))
    }

    /// Returns how the response that is due now is delivered. After a loss of power the peripheral has forgotten all.
    pub fn delivery(&mut self, now: Mono) -> Delivery {
        let left = |fault: &Fault, t: f64| fault.left(t);
        let t = self.time(now);
        if let Some(fault) = self.take(FaultKind::PowerLoss, now) {
            return Delivery::PowerLoss(left(&fault, t).unwrap_or_default());
        }
        if let Some(fault) = self.take(FaultKind::Stall, now) {
            return Delivery::Stall(left(&fault, t).unwrap_or(DEFAULT_STALL));
        }
        if let Some(fault) = self.take(FaultKind::Disconnect, now) {
            return Delivery::Disconnect(left(&fault, t).unwrap_or_default());
        }
        let faults = [
            (FaultKind::Silent, Delivery::Silent),
            (FaultKind::Truncated, Delivery::Truncated),
            (FaultKind::Corrupt, Delivery::Corrupt),
            (FaultKind::Garbage, Delivery::Garbage),
        ];
        let due = faults.iter().find(|(kind, _)| self.take(*kind, now).is_some());
        due.map_or(Delivery::Send, |(_, delivery)| *delivery)
    }

    /// Adds a fault that begins `fault.at` seconds from `now`.
    pub fn inject(&mut self, fault: Fault, now: Mono) -> Result<(), String> {
        check_kind(self.name, &fault, self.playable)?;
        self.requested(now);
        let t = self.time(now);
        self.script.inject(fault, t);
        Ok(())
    }
}

/// A running emulator of a peripheral. It ends when it is dropped.
pub enum PeripheralServer<C: Controller> {
    /// On a pseudo-terminal.
    Serial(SerialServer<C>),
    /// On a TCP port.
    Tcp(TcpServer<C>),
}

impl<C: Emulated> PeripheralServer<C> {
    /// Starts a peripheral at `place`: at `port` of a loopback address, or on a pseudo-terminal. For this program only
    /// it is on a pseudo-terminal, unless it speaks `tcp`.
    pub fn start(name: &str, device: C, place: &EmulatorAddress, port: u16, tcp: bool) -> AdapterResult<Self> {
        match place {
            EmulatorAddress::InProcess if !tcp => SerialServer::start(name, device, place).map(Self::Serial),
            EmulatorAddress::Pty => SerialServer::start(name, device, place).map(Self::Serial),
            _ => TcpServer::start(name, device, place.tcp(port)?).map(Self::Tcp),
        }
    }

    /// Calls `f` with the peripheral and the current time.
    pub fn with<T>(&self, f: impl FnOnce(&mut C, Mono) -> T) -> T {
        match self {
            Self::Serial(server) => server.with(f),
            Self::Tcp(server) => server.with(f),
        }
    }
}

impl<C: Emulated> Emulator for PeripheralServer<C> {
    fn address(&self) -> String {
        match self {
            Self::Serial(server) => server.path().to_owned(),
            Self::Tcp(server) => format!("tcp:{}", server.address()),
        }
    }

    fn inject(&self, fault: Fault) -> Result<(), String> {
        self.with(|device, now| device.faults().inject(fault, now))
    }

    fn truth(&self) -> Truth {
        self.with(|device, now| device.truth(now))
    }
}
