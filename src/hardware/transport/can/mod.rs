//! CAN: frames, and the ports that carry them. What an arm's adapter and its emulator see of a bus, whichever kind it
//! is: an interface of the system, a serial adapter that speaks slcan, or a bus in memory.

use std::os::fd::BorrowedFd;

use crate::hardware::spec::AdapterResult;

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

/// What the controller of the bus reports beside frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CanTrouble {
    /// The controller has left the bus after too many errors.
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

/// One end of a bus. Nothing here waits or allocates.
pub trait CanPort: Send {
    /// Hands frames to the bus, in order. Answers how many it took: fewer than all where its queue is full, and the
    /// rest is dropped. `Io` when the interface is gone or down.
    fn send(&mut self, frames: &[CanFrame]) -> AdapterResult<usize>;
    /// The next event, if one has arrived. `Io` when the interface is gone or down.
    fn receive(&mut self) -> AdapterResult<Option<CanEvent>>;
    /// Readable when something has arrived.
    fn fd(&self) -> BorrowedFd<'_>;
}
