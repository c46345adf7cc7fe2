//! What an emulated arm is connected to: a bus in memory, a CAN interface of the system, or a serial line behind a CAN
//! adapter. And what faults of the bus do there.

use std::os::fd::BorrowedFd;
use std::time::Duration;

use super::arm::Delivery;
use crate::clock::{Clock, Mono, MonotonicClock};
use crate::hardware::adapter::{AdapterError, AdapterResult};
use crate::hardware::registry::EmulatorAddress;
use crate::hardware::transport::can::bus::{Bus, SEND_QUEUE};
use crate::hardware::transport::can::slcan_pty::SlcanPty;
use crate::hardware::transport::can::{self, CanAddress, CanEvent, CanFilter, CanFrame, CanPort, CanTrouble};

/// How long an interface is down that goes down and up again.
const DOWN: Duration = Duration::from_millis(100);
/// Longest wait until a bus has room again for what the arm sends.
const ROOM_TIMEOUT: Duration = Duration::from_millis(3);
/// Time between looks whether it has.
const LOOK: Duration = Duration::from_micros(200);
/// Frames of one command, which a bus without room does not take.
const COMMAND: usize = 4;
/// Time between attempts to open an interface that is down.
const REOPEN: Duration = Duration::from_millis(50);

/// The arm's connection to its bus.
pub(super) struct CanConnection {
    kind: Kind,
    port: Option<Box<dyn CanPort>>,
    /// The other nodes have no power until then; the interface is down until then, or not opened before.
    dark: Option<Mono>,
    down: Option<Mono>,
    /// The bus takes nothing from programs.
    full: bool,
}

enum Kind {
    /// The wire of a bus in memory.
    Memory(Bus),
    /// An interface of the system, which may go down and come back.
    Interface { device: String, address: CanAddress, filters: &'static [CanFilter] },
    /// A serial line.
    Serial,
}

impl CanConnection {
    /// Connects the arm `name` at `place`, and says where adapters find the bus.
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

    /// Readable when something has arrived; `None` while the interface is gone.
    pub fn fd(&self) -> Option<BorrowedFd<'_>> {
        self.port.as_ref().map(|port| port.fd())
    }

    /// The next event, if one has arrived.
    pub fn receive(&mut self, now: Mono) -> Option<CanEvent> {
        match self.port.as_mut()?.receive() {
            Ok(event) => event,
            Err(_) => {
                self.lose(now);
                None
            }
        }
    }

    /// Sends frames; waits a little for room. Returns how many the bus took.
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
                std::thread::sleep(LOOK);
            }
        }
        done
    }

    /// The interface is gone: it is opened again after a while.
    fn lose(&mut self, now: Mono) {
        self.port = None;
        self.down = Some(now.after(REOPEN));
    }

    /// Opens an interface that was gone, when it is time for another attempt.
    pub fn open(&mut self, now: Mono) {
        if let (None, Kind::Interface { device, address, filters }) = (&self.port, &self.kind)
            && self.down.is_none_or(|down| now >= down)
        {
            self.port = can::open(device, address, filters).ok();
            self.down = Some(now.after(REOPEN));
        }
    }

    // --- Faults of the bus: all but the silence of an arm without power only on a bus in memory ---

    fn bus(&self) -> Option<&Bus> {
        match &self.kind {
            Kind::Memory(bus) => Some(bus),
            _ => None,
        }
    }

    /// Lets faults end that are over.
    pub fn mend(&mut self, now: Mono) {
        let Kind::Memory(bus) = &self.kind else { return };
        if self.dark.take_if(|dark| now >= *dark).is_some() {
            bus.acknowledge();
        }
        if self.down.take_if(|down| now >= *down).is_some() {
            bus.set_up(true);
        }
    }

    /// Nobody acknowledges what programs send until `dark`.
    pub fn lose_power(&mut self, dark: Mono) {
        if let Some(bus) = self.bus() {
            bus.withhold(SEND_QUEUE);
            self.dark = Some(dark);
        }
    }

    /// Takes the interface down for `time`; `false` where it cannot.
    pub fn go_down(&mut self, now: Mono, time: Duration) -> bool {
        let Some(bus) = self.bus() else { return false };
        if self.down.is_none() {
            bus.set_up(false);
            self.down = Some(now.after(if time.is_zero() { DOWN } else { time }));
        }
        true
    }

    /// The computer's controller leaves the bus.
    pub fn bus_off(&self) {
        self.bus().into_iter().for_each(|bus| bus.trouble(CanTrouble::BusOff));
    }

    /// Lets the bus refuse what programs send, for as long as a delivery says so.
    pub fn refuse(&mut self, delivery: Delivery) {
        let frames = match delivery {
            Delivery::NoBuffers(false) => COMMAND,
            Delivery::NoBuffers(true) => usize::MAX,
            _ if self.full => 0,
            _ => return,
        };
        self.bus().into_iter().for_each(|bus| bus.refuse(frames));
        self.full = delivery == Delivery::NoBuffers(true);
    }
}
