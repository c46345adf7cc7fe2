//! The bus of an emulated arm: in memory, a CAN interface of the system, or a serial CAN adapter. Plays the faults of
//! the bus.

use std::os::fd::BorrowedFd;
use std::time::Duration;

use super::arm::Delivery;
use crate::adapter::{AdapterError, AdapterResult};
use crate::registry::EmulatorAddress;
use crate::transport::can::bus::{Bus, SEND_QUEUE};
use crate::transport::can::slcan_pty::SlcanPty;
use crate::transport::can::{self, CanAddress, CanEvent, CanFilter, CanFrame, CanPort, CanTrouble};
use dimos_core::clock::{Clock, Mono, MonotonicClock};

/// How long an interface stays down by default.
const DOWN_TIME: Duration = Duration::from_millis(100);
/// Maximum wait until the bus has room for what the arm sends.
const ROOM_TIMEOUT: Duration = Duration::from_millis(3);
/// Time between two attempts to send.
const RETRY_PERIOD: Duration = Duration::from_micros(200);
/// Frames of one command, which a full bus refuses.
const FRAMES_PER_COMMAND: usize = 4;
/// Time between two attempts to open an interface that is down.
const REOPEN: Duration = Duration::from_millis(50);

/// The arm's connection to its bus.
pub(super) struct CanConnection {
    kind: Kind,
    port: Option<Box<dyn CanPort>>,
    /// Until when the other nodes have no power, and until when the interface is down or not reopened.
    dark: Option<Mono>,
    down: Option<Mono>,
    /// Whether the bus refuses frames of programs.
    full: bool,
}

enum Kind {
    /// A bus in memory.
    Memory(Bus),
    /// An interface of the system, which may go down and come up again.
    Interface { device: String, address: CanAddress, filters: &'static [CanFilter] },
    /// A serial line.
    Serial,
}

impl CanConnection {
    /// Connects the arm `name` at `place`, and returns the address for adapters.
    pub fn take(
        name: &str,
        place: &EmulatorAddress,
        filters: &'static [CanFilter],
    ) -> AdapterResult<(Self, CanAddress)> {
        let (kind, port, address): (_, Box<dyn CanPort>, _) = match place {
            EmulatorAddress::InProcess => {
                let bus = Bus::new();
                let (port, address) = (bus.attach()?, bus.address());
                (Kind::Memory(bus), Box::new(port), address)
            }
            EmulatorAddress::Can(interface) => {
                let address = CanAddress::parse(interface).map_err(AdapterError::Rejected)?;
                let device = format!("the {name} emulator");
                let port = can::open(&device, &address, filters)?;
                (Kind::Interface { device, address: address.clone(), filters }, port, address)
            }
            EmulatorAddress::Pty => {
                let pty = SlcanPty::open()?;
                let address = pty.address();
                (Kind::Serial, Box::new(pty), address)
            }
            EmulatorAddress::Bind(_) => {
                let what = "is on a CAN bus: its emulator has an interface or a pseudo-terminal, no IP address";
                return Err(AdapterError::Rejected(format!("{name} {what}")));
            }
        };
        Ok((Self { kind, port: Some(port), dark: None, down: None, full: false }, address))
    }

    /// Returns a descriptor that becomes readable when a frame arrives; `None` while the interface is down.
    pub fn fd(&self) -> Option<BorrowedFd<'_>> {
        self.port.as_ref().map(|port| port.fd())
    }

    /// Returns the next event, if one has arrived.
    pub fn receive(&mut self, now: Mono) -> Option<CanEvent> {
        match self.port.as_mut()?.receive() {
            Ok(event) => event,
            Err(_) => {
                self.lose(now);
                None
            }
        }
    }

    /// Sends frames; waits briefly for room. Returns how many the bus took.
    pub fn send(&mut self, frames: &[CanFrame]) -> usize {
        let end = MonotonicClock.now().after(ROOM_TIMEOUT);
        let mut done = 0;
        while let Some(port) = &mut self.port
            && done < frames.len()
        {
            match port.send(frames.get(done..).unwrap_or_default()) {
                Ok(taken) => done += taken,
                Err(_) => self.lose(end),
            }
            if done < frames.len() {
                if MonotonicClock.now() >= end {
                    break;
                }
                std::thread::sleep(RETRY_PERIOD);
            }
        }
        done
    }

    /// Marks the interface as gone and schedules an attempt to reopen it.
    fn lose(&mut self, now: Mono) {
        self.port = None;
        self.down = Some(now.after(REOPEN));
    }

    /// Reopens an interface that is gone, when the next attempt is due.
    pub fn open(&mut self, now: Mono) {
        if let (None, Kind::Interface { device, address, filters }) = (&self.port, &self.kind)
            && self.down.is_none_or(|down| now >= down)
        {
            self.port = can::open(device, address, filters).ok();
            self.down = Some(now.after(REOPEN));
        }
    }

    // --- Faults of the bus; only a bus in memory can play them ---

    fn bus(&self) -> Option<&Bus> {
        match &self.kind {
            Kind::Memory(bus) => Some(bus),
            _ => None,
        }
    }

    /// Ends faults whose time is over.
    pub fn end_faults(&mut self, now: Mono) {
        let Kind::Memory(bus) = &self.kind else { return };
        if self.dark.take_if(|dark| now >= *dark).is_some() {
            bus.acknowledge();
        }
        if self.down.take_if(|down| now >= *down).is_some() {
            bus.set_up(true);
        }
    }

    /// Loses power: no node acknowledges frames of programs until `dark`.
    pub fn lose_power(&mut self, dark: Mono) {
        if let Some(bus) = self.bus() {
            bus.withhold(SEND_QUEUE);
            self.dark = Some(dark);
        }
    }

    /// Takes the interface down for `time`. Returns `false` if that is not possible.
    pub fn go_down(&mut self, now: Mono, time: Duration) -> bool {
        let Some(bus) = self.bus() else { return false };
        if self.down.is_none() {
            bus.set_up(false);
            self.down = Some(now.after(if time.is_zero() { DOWN_TIME } else { time }));
        }
        true
    }

    /// Sets the computer's CAN controller to bus-off.
    pub fn bus_off(&self) {
        self.bus().into_iter().for_each(|bus| bus.trouble(CanTrouble::BusOff));
    }

    /// Lets the bus refuse frames of programs, as `delivery` says.
    pub fn refuse(&mut self, delivery: Delivery) {
        let frames = match delivery {
            Delivery::NoBuffers(false) => FRAMES_PER_COMMAND,
            Delivery::NoBuffers(true) => usize::MAX,
            _ if self.full => 0,
            _ => return,
        };
        self.bus().into_iter().for_each(|bus| bus.refuse(frames));
        self.full = delivery == Delivery::NoBuffers(true);
    }
}
