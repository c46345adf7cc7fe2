//! Wake-ups: an eventfd that one thread waits on and others raise without blocking.

use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::Arc;
use std::time::Duration;

use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};

/// The waiting end and the raising end in one; clones share the same event.
#[derive(Debug, Clone)]
pub struct Wake(Arc<OwnedFd>);

impl Wake {
    /// A new event, not raised.
    pub fn new() -> io::Result<Self> {
        Ok(Self(Arc::new(eventfd(0, EventfdFlags::NONBLOCK | EventfdFlags::CLOEXEC)?)))
    }

    /// Raises the event: one non-blocking write, fit for the tick.
    pub fn raise(&self) {
        // The only possible failure is a full counter, and then it is raised already.
        let _ = rustix::io::write(self.0.as_fd(), &1u64.to_ne_bytes());
    }

    /// Waits until the event is raised or the time is over, and lowers it. `true`: it was raised.
    pub fn wait(&self, timeout: Duration) -> bool {
        let timeout = Timespec { tv_sec: timeout.as_secs() as i64, tv_nsec: timeout.subsec_nanos() as i64 };
        let mut fds = [PollFd::new(&*self.0, PollFlags::IN)];
        match poll(&mut fds, Some(&timeout)) {
            Ok(n) if n > 0 => {
                self.lower();
                true
            }
            _ => false,
        }
    }

    /// Lowers the event without waiting.
    pub fn lower(&self) {
        let _ = rustix::io::read(self.0.as_fd(), &mut [0u8; 8]);
    }
}

impl AsFd for Wake {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}

impl std::os::fd::AsRawFd for Wake {
    fn as_raw_fd(&self) -> std::os::fd::RawFd {
        std::os::fd::AsRawFd::as_raw_fd(&*self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_raised_event_ends_one_wait() {
        let wake = Wake::new().unwrap();
        assert!(!wake.wait(Duration::ZERO));
        wake.raise();
        wake.raise();
        assert!(wake.wait(Duration::from_secs(1)));
        assert!(!wake.wait(Duration::ZERO));
    }
}
