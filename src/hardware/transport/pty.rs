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
use crate::hardware::adapter::{AdapterError, AdapterResult};
use crate::sync::lock;

/// So many lines that are gone keep their numbers. The system would give them to the next lines, and a client that
/// comes back for its own would find another's.
const KEEP: usize = 64;
/// The far ends that keep them.
static GONE: Mutex<VecDeque<OwnedFd>> = Mutex::new(VecDeque::new());

/// A new serial line without hardware: clients open [`Pty::path`], the emulator has this end. Dropping it looks to
/// them as if the device were unplugged.
#[derive(Debug)]
pub struct Pty {
    near: OwnedFd,
    /// Held open so that a client that goes is no end of the line: the next may come.
    far: Option<OwnedFd>,
    path: String,
}

impl Pty {
    /// Makes a new one.
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

    /// What clients open: `/dev/pts/3`.
    pub fn path(&self) -> &str {
        &self.path
    }

    /// Reads what clients have sent, waiting up to `timeout`; 0 when nothing has come.
    pub fn read(&self, room: &mut [u8], timeout: Duration) -> AdapterResult<usize> {
        match wait(&self.near, PollFlags::IN, timeout).and_then(|_| rustix::io::read(&self.near, room)) {
            Ok(n) => Ok(n),
            Err(Errno::AGAIN | Errno::INTR) => Ok(0),
            Err(e) => Err(self.broken(e)),
        }
    }

    /// Sends to the client; answers how many bytes there was room for: what nobody reads fills the line, and the rest
    /// is up to the caller.
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
