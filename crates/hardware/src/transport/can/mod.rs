//! CAN frames and ports. Adapters and emulators use the same interface for every kind of bus: an interface of the
//! system ([`socket`]), a serial adapter with slcan ([`slcan`]), or a bus in memory ([`bus`]).
//!
//! Ports never block; a caller waits for [`CanPort::fd`] to become readable.

pub mod address;
pub mod bus;
#[cfg(feature = "can")]
mod in_flight;
pub mod slcan;
pub mod slcan_pty;
#[cfg(all(feature = "can", target_os = "linux"))]
pub mod socket;

use std::os::fd::BorrowedFd;

use super::capture::Tap;
use crate::adapter::AdapterResult;
pub use address::CanAddress;
pub use bus::Bus;
pub use slcan_pty::SlcanPty;

/// A classic CAN 2.0A data frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct CanFrame {
    /// Identifier, 11 bits.
    pub id: u16,
    /// Number of data bytes (0–8).
    pub len: u8,
    /// The data; bytes past `len` are 0.
    pub data: [u8; 8],
}

impl CanFrame {
    /// Creates a frame with these data bytes; those past the eighth are dropped.
    pub fn new(id: u16, bytes: &[u8]) -> Self {
        let mut data = [0; 8];
        data.iter_mut().zip(bytes).for_each(|(to, from)| *to = *from);
        Self { id, len: bytes.len().min(8) as u8, data }
    }

    /// Returns the data bytes.
    pub fn bytes(&self) -> &[u8] {
        self.data.get(..usize::from(self.len)).unwrap_or(&self.data)
    }
}

/// Events that the bus controller reports besides frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CanTrouble {
    /// Bus-off: the controller has left the bus after too many errors. Frames sent from now on are lost silently.
    BusOff,
    /// No node acknowledges: no other node, no power, or a wrong bit rate.
    NoAcknowledge,
    /// Error-passive: many errors, but the controller still takes part.
    Passive,
    /// The controller is active again.
    Restarted,
    /// Frames were lost because they were not read in time.
    Overflow,
    /// Another error frame, by its class bits.
    Other(u32),
}

/// An event of a port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CanEvent {
    /// A frame.
    Frame(CanFrame),
    /// Trouble on the bus.
    Trouble(CanTrouble),
}

/// Filter of a port: receives frames whose identifier equals `id` in the bits set in `mask`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CanFilter {
    /// Identifier, 11 bits.
    pub id: u16,
    /// Significant bits; `0x7FF` for exactly one identifier.
    pub mask: u16,
}

impl CanFilter {
    /// Returns whether the filter accepts this identifier.
    pub fn passes(&self, id: u16) -> bool {
        id & self.mask == self.id & self.mask
    }

    /// Returns whether any of `filters` accepts the identifier; without filters all are accepted.
    pub fn any(filters: &[Self], id: u16) -> bool {
        filters.is_empty() || filters.iter().any(|filter| filter.passes(id))
    }
}

/// One end of a bus. Its methods neither block nor allocate.
///
/// A port that has returned `Io` stays broken even when the interface comes back: open another one.
pub trait CanPort: Send {
    /// Sends frames in order. Returns how many the bus took: fewer than all if its queue is full; the rest is dropped.
    /// `Io` if the interface is gone or down.
    fn send(&mut self, frames: &[CanFrame]) -> AdapterResult<usize>;
    /// Returns the next event, if one has arrived. `Io` if the interface is gone or down.
    fn receive(&mut self) -> AdapterResult<Option<CanEvent>>;
    /// Becomes readable when an event has arrived. Receive until there is none before waiting.
    fn fd(&self) -> BorrowedFd<'_>;
    /// Returns approximately how many frames of this port wait for the bus, if known; frames transmitted since the last
    /// [`CanPort::receive`] may be included. If the number stays above 0, no node acknowledges: the frames are sent
    /// later, when one does.
    fn waiting(&self) -> usize {
        0
    }
    /// Takes back the frames of this port that have not left this computer, if possible. Returns how many still wait:
    /// those are sent when a node acknowledges, so send nothing new before [`CanPort::waiting`] is 0.
    fn discard(&mut self) -> AdapterResult<usize> {
        Ok(self.waiting())
    }
}

/// Opens a port on the bus at `address`. It receives the frames of other nodes that `filters` accept (all without
/// filters), and always trouble. On an interface of the system, its own frames are tracked until they are transmitted
/// if `filters` accept them, so include the identifiers of setpoints. `device` names the arm in messages. Errors
/// contain a hint.
pub fn open(device: &str, address: &CanAddress, filters: &[CanFilter]) -> AdapterResult<Box<dyn CanPort>> {
    let port: Box<dyn CanPort> = match address {
        CanAddress::Memory(number) => Box::new(bus::open(device, *number, filters)?),
        CanAddress::Slcan { path, bit_rate } => Box::new(slcan::open(device, path, *bit_rate, filters)?),
        CanAddress::Interface(name) => open_interface(device, name, filters)?,
    };
    Ok(Box::new(Captured { port, tap: Tap::open(|| address.to_string(), true, None) }))
}

/// A port whose frames can be captured.
struct Captured {
    port: Box<dyn CanPort>,
    tap: Tap,
}

impl CanPort for Captured {
    fn send(&mut self, frames: &[CanFrame]) -> AdapterResult<usize> {
        let taken = self.port.send(frames)?;
        frames.iter().take(taken).for_each(|frame| self.tap.keep(true, &[&frame.id.to_be_bytes(), frame.bytes()]));
        Ok(taken)
    }

    fn receive(&mut self) -> AdapterResult<Option<CanEvent>> {
        let event = self.port.receive()?;
        if let Some(CanEvent::Frame(frame)) = &event {
            self.tap.keep(false, &[&frame.id.to_be_bytes(), frame.bytes()]);
        }
        Ok(event)
    }

    fn fd(&self) -> BorrowedFd<'_> {
        self.port.fd()
    }

    fn waiting(&self) -> usize {
        self.port.waiting()
    }

    fn discard(&mut self) -> AdapterResult<usize> {
        self.port.discard()
    }
}

/// Whether this build supports CAN interfaces of the system.
const INTERFACES: bool = cfg!(all(feature = "can", target_os = "linux"));

/// Returns the complete address, for the adapter table; refuses what this build does not support. Opens nothing.
pub fn check(address: &str) -> Result<String, String> {
    match CanAddress::parse(address)? {
        CanAddress::Interface(name) if !INTERFACES => Err(format!(
            "this build reaches no CAN interface such as {name}: build with --features can, on Linux, or take a serial \
             adapter, slcan:/dev/ttyX"
        )),
        address => Ok(address.to_string()),
    }
}

#[cfg(all(feature = "can", target_os = "linux"))]
fn open_interface(device: &str, name: &str, filters: &[CanFilter]) -> AdapterResult<Box<dyn CanPort>> {
    Ok(Box::new(socket::open(device, name, filters)?))
}

#[cfg(not(all(feature = "can", target_os = "linux")))]
fn open_interface(device: &str, name: &str, _filters: &[CanFilter]) -> AdapterResult<Box<dyn CanPort>> {
    Err(crate::adapter::AdapterError::Io(format!(
        "cannot open CAN interface {name} for {device}: this build has no CAN\nhint: build with --features can, on Linux"
    )))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_interface_is_refused_by_a_build_that_cannot_reach_it() {
        assert_eq!(check("slcan:/dev/ttyACM0").as_deref(), Ok("slcan:/dev/ttyACM0@1000000"));
        match check("can0") {
            Ok(address) => assert!(INTERFACES && address == "can0"),
            Err(why) => assert!(!INTERFACES && why.contains("such as can0: build with --features can"), "{why}"),
        }
    }

    #[cfg(not(feature = "can"))]
    #[test]
    fn a_build_without_can_says_so() {
        let error = open("arm", &CanAddress::Interface("can0".into()), &[]).err().unwrap().to_string();
        let hint = "this build has no CAN\nhint: build with --features can, on Linux";
        assert_eq!(error, format!("cannot open CAN interface can0 for arm: {hint}"));
    }

    #[test]
    fn frames_hold_eight_bytes_at_most() {
        assert_eq!(CanFrame::new(0x151, &[1, 2]), CanFrame { id: 0x151, len: 2, data: [1, 2, 0, 0, 0, 0, 0, 0] });
        assert_eq!(CanFrame::new(1, &[7; 12]).bytes(), [7; 8]);
        assert_eq!(CanFrame { id: 1, len: 200, data: [3; 8] }.bytes(), [3; 8]);
    }

    #[test]
    fn filters_look_at_the_bits_of_their_mask() {
        let joints = CanFilter { id: 0x2A0, mask: 0x7F0 };
        assert!(joints.passes(0x2A5) && !joints.passes(0x251));
        assert!(CanFilter::any(&[], 0x7FF));
        assert!(CanFilter::any(&[CanFilter { id: 1, mask: 0x7FF }, joints], 0x2AF));
        assert!(!CanFilter::any(&[joints], 0x4AF));
    }
}
