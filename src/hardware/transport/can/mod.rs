//! CAN: frames, and the ports that carry them. What an arm's adapter and its emulator see of a bus, whichever kind it
//! is: an interface of the system ([`socket`]), a serial adapter that speaks slcan ([`slcan`]), or a bus in memory
//! ([`bus`]).
//!
//! Ports never wait: a caller that has nothing to do waits for [`CanPort::fd`] to become readable.

pub mod address;
pub mod bus;
#[cfg(feature = "can")]
mod in_flight;
pub mod slcan;
pub mod slcan_pty;
#[cfg(all(feature = "can", target_os = "linux"))]
pub mod socket;

use std::os::fd::BorrowedFd;

use crate::hardware::adapter::AdapterResult;
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
    /// A frame with these data bytes; those past the eighth are left out.
    pub fn new(id: u16, bytes: &[u8]) -> Self {
        let mut data = [0; 8];
        data.iter_mut().zip(bytes).for_each(|(to, from)| *to = *from);
        Self { id, len: bytes.len().min(8) as u8, data }
    }

    /// The data bytes.
    pub fn bytes(&self) -> &[u8] {
        self.data.get(..usize::from(self.len)).unwrap_or(&self.data)
    }
}

/// What the controller of the bus reports beside frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CanTrouble {
    /// The controller has left the bus after too many errors. What is sent from now on is swallowed without a word.
    BusOff,
    /// Nobody acknowledges what is sent: no other node, no power, a wrong bit rate.
    NoAcknowledge,
    /// Many errors: the controller still takes part, passively.
    Passive,
    /// The controller is back.
    Restarted,
    /// Frames were lost because they were not fetched in time.
    Overflow,
    /// Another error frame, by its class bits.
    Other(u32),
}

/// What has arrived.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CanEvent {
    /// A frame.
    Frame(CanFrame),
    /// Trouble on the bus.
    Trouble(CanTrouble),
}

/// Which frames a port wants: those whose identifier agrees with `id` in the bits that are set in `mask`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CanFilter {
    /// Identifier, 11 bits.
    pub id: u16,
    /// The bits of it that count; `0x7FF` for one identifier alone.
    pub mask: u16,
}

impl CanFilter {
    /// Whether a frame with this identifier is wanted.
    pub fn passes(&self, id: u16) -> bool {
        id & self.mask == self.id & self.mask
    }

    /// Whether one of `filters` wants it; without filters every frame is wanted.
    pub fn any(filters: &[Self], id: u16) -> bool {
        filters.is_empty() || filters.iter().any(|filter| filter.passes(id))
    }
}

/// One end of a bus. Nothing here waits or allocates.
///
/// A port that has answered `Io` stays broken, also when the interface comes back: open another one.
pub trait CanPort: Send {
    /// Hands frames to the bus, in order. Answers how many it took: fewer than all where its queue is full, and the
    /// rest is dropped. `Io` when the interface is gone or down.
    fn send(&mut self, frames: &[CanFrame]) -> AdapterResult<usize>;
    /// The next event, if one has arrived. `Io` when the interface is gone or down.
    fn receive(&mut self) -> AdapterResult<Option<CanEvent>>;
    /// Readable when something has arrived. Fetch until there is nothing before waiting for it.
    fn fd(&self) -> BorrowedFd<'_>;
    /// About how many frames of this port still wait for the bus, where that can be known; what was transmitted since
    /// the last [`CanPort::receive`] may be among them. A number that stays above 0 says that no node acknowledges:
    /// those frames go out later, when one does.
    fn waiting(&self) -> usize {
        0
    }
    /// Takes back the frames of this port that have not left this computer, where that is possible. Answers how many
    /// still wait: those go out when a node acknowledges, so send nothing new before [`CanPort::waiting`] is 0.
    fn discard(&mut self) -> AdapterResult<usize> {
        Ok(self.waiting())
    }
}

/// Opens a port on the bus at `address`. It hears what `filters` want of the frames that others send, everything
/// without filters, and trouble always. On an interface of the system, frames that it sends itself are followed until
/// they are transmitted if `filters` want them: name the identifiers of setpoints too. `device` names the arm in
/// messages. Errors say what to do.
pub fn open(device: &str, address: &CanAddress, filters: &[CanFilter]) -> AdapterResult<Box<dyn CanPort>> {
    match address {
        CanAddress::Memory(number) => Ok(Box::new(bus::open(device, *number, filters)?)),
        CanAddress::Slcan { path, bit_rate } => Ok(Box::new(slcan::open(device, path, *bit_rate, filters)?)),
        CanAddress::Interface(name) => open_interface(device, name, filters),
    }
}

/// Whether this build reaches CAN interfaces of the system.
const INTERFACES: bool = cfg!(all(feature = "can", target_os = "linux"));

/// The address in full, for the adapter table; refuses what this build cannot reach. Asks nobody.
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
    Err(crate::hardware::adapter::AdapterError::Io(format!(
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
