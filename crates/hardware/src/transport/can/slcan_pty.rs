//! A serial CAN adapter without hardware: the far end of slcan on a pseudo-terminal, for emulators.
//!
//! Clients, such as this program or a vendor's SDK, open its path like `/dev/ttyACM0`.

use std::os::fd::{AsFd, BorrowedFd};
use std::time::Duration;

use super::slcan::{Lines, decode};
use super::{CanAddress, CanEvent, CanFrame, CanPort};
use crate::adapter::AdapterResult;
use crate::transport::pty::Pty;

/// The adapter, and the port of the arm behind it: it receives what clients send.
///
/// Frames sent while no client has opened the channel are lost, as on a bus without receivers. Dropping it looks to
/// clients as if the adapter were unplugged.
pub struct SlcanPty {
    line: Lines<Pty>,
    path: String,
    channel_open: bool,
}

/// A message of a client.
enum ClientMessage {
    Frame(CanFrame),
    Command(u8, Option<u8>),
}

impl SlcanPty {
    /// Opens a new adapter.
    pub fn open() -> AdapterResult<Self> {
        let pty = Pty::open()?;
        let path = pty.path().to_owned();
        Ok(Self { line: Lines::new(pty, format!("the client of {path}")), path, channel_open: false })
    }

    /// Returns the path for clients: `/dev/pts/3`.
    pub fn path(&self) -> &str {
        &self.path
    }

    /// Returns the address for this program's adapters.
    pub fn address(&self) -> CanAddress {
        CanAddress::Slcan { path: self.path.clone(), bit_rate: super::address::BIT_RATE }
    }

    /// Returns whether a client has opened the channel.
    pub fn channel_open(&self) -> bool {
        self.channel_open
    }

    /// Executes a client's command; `false` if that is not possible.
    fn execute(&mut self, command: u8, argument: Option<u8>) -> bool {
        match (command, argument) {
            (b'C', None) => self.channel_open = false,
            // The rate can only be set on a closed channel.
            (b'S', Some(b'0'..=b'8')) if !self.channel_open => {}
            // Opening twice is allowed: a vendor's SDK opens once to send and once to receive.
            (b'O', None) => self.channel_open = true,
            _ => return false,
        }
        true
    }
}

impl CanPort for SlcanPty {
    fn send(&mut self, frames: &[CanFrame]) -> AdapterResult<usize> {
        if self.channel_open { self.line.put_frames(frames) } else { Ok(frames.len()) }
    }

    fn receive(&mut self) -> AdapterResult<Option<CanEvent>> {
        let said = |line: &[u8]| match line {
            [b't', ..] => decode(line).map(ClientMessage::Frame),
            [command] => Some(ClientMessage::Command(*command, None)),
            [command, argument] => Some(ClientMessage::Command(*command, Some(*argument))),
            [] => None,
            [command, ..] => Some(ClientMessage::Command(*command, Some(0))),
        };
        while let Some(said) = self.line.next(said, |pty, _, room| pty.read(room, Duration::ZERO))? {
            let reply: &[u8] = match said {
                ClientMessage::Frame(frame) if self.channel_open => {
                    self.line.put(b"z\r")?;
                    return Ok(Some(CanEvent::Frame(frame)));
                }
                ClientMessage::Command(command, argument) if self.execute(command, argument) => b"\r",
                _ => b"\x07",
            };
            self.line.put(reply)?;
        }
        Ok(None)
    }

    fn fd(&self) -> BorrowedFd<'_> {
        self.line.fd.as_fd()
    }
}

#[cfg(test)]
#[path = "slcan_tests.rs"]
mod slcan_tests;
