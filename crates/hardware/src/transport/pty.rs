//! A pseudo-terminal: the far end of a serial line, for emulators.

use std::collections::VecDeque;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::Mutex;
use std::time::Duration;

use rustix::event::PollFlags;
use rustix::io::Errno;
use rustix::pty::{OpenptFlags, grantpt, ioctl_tiocgptpeer, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

use super::serial::{make_raw, wait};
use crate::adapter::{AdapterError, AdapterResult};
use dimos_core::sync::lock;

/// Number of closed lines whose device numbers are kept. The system would reuse them for the next lines, and a client
/// that reconnects would find another arm's.
const KEEP: usize = 64;
/// The far ends that keep these numbers.
static GONE: Mutex<VecDeque<OwnedFd>> = Mutex::new(VecDeque::new());

/// A serial line without hardware: clients open [`Pty::path`], the emulator has this end. Dropping it looks to them as
/// if the device were unplugged.
#[derive(Debug)]
pub struct Pty {
    near: OwnedFd,
    /// Held open, so that the line survives a client that closes it.
    far: Option<OwnedFd>,
    path: String,
}

impl Pty {
    /// Opens a new pseudo-terminal.
    pub fn open() -> AdapterResult<Self> {
        let make = || -> rustix::io::Result<Self> {
            let flags = OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC;
            let near = openpt(flags)?;
            grantpt(&near)?;
            unlockpt(&near)?;
            let far = ioctl_tiocgptpeer(&near, flags)?;
            let mut settings = tcgetattr(&far)?;
            make_raw(&mut settings);
            tcsetattr(&far, OptionalActions::Now, &settings)?;
            rustix::io::ioctl_fionbio(&near, true)?;
            let path = ptsname(&near, Vec::new())?.to_string_lossy().into_owned();
            Ok(Self { near, far: Some(far), path })
        };
        make().map_err(|e| AdapterError::Io(format!("cannot make a pseudo-terminal: {e}")))
    }

    /// Returns the path for clients: `/dev/pts/3`.
    pub fn path(&self) -> &str {
        &self.path
    }

    /// Reads bytes from clients, waiting up to `timeout`; 0 if none arrived.
    pub fn read(&self, room: &mut [u8], timeout: Duration) -> AdapterResult<usize> {
        match wait(&self.near, PollFlags::IN, timeout).and_then(|_| rustix::io::read(&self.near, room)) {
            Ok(n) => Ok(n),
            Err(Errno::AGAIN | Errno::INTR) => Ok(0),
            Err(e) => Err(self.broken(e)),
        }
    }

    /// Sends to the client; returns how many bytes there was room for. Unread bytes fill the line; the caller handles
    /// the rest.
    pub fn write(&self, bytes: &[u8]) -> AdapterResult<usize> {
        match rustix::io::write(&self.near, bytes) {
            Ok(n) => Ok(n),
            Err(Errno::AGAIN | Errno::INTR) => Ok(0),
            Err(e) => Err(self.broken(e)),
        }
    }

    fn broken(&self, error: Errno) -> AdapterError {
        AdapterError::Io(format!("the pseudo-terminal {} broke: {error}", self.path))
    }
}

impl Drop for Pty {
    fn drop(&mut self) {
        let mut gone = lock(&GONE);
        gone.extend(self.far.take());
        let excess = gone.len().saturating_sub(KEEP);
        gone.drain(..excess);
    }
}

impl AsFd for Pty {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.near.as_fd()
    }
}
