//! Wake-ups: an eventfd that one thread waits on and others raise without blocking.

use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::Arc;
use std::time::Duration;

use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};

/// An event for waiting and raising; clones share it.
#[derive(Debug, Clone)]
pub struct Wake(Arc<OwnedFd>);

impl Wake {
    /// Creates an event that is not raised.
    pub fn new() -> io::Result<Self> {
        Ok(Self(Arc::new(eventfd(0, EventfdFlags::NONBLOCK | EventfdFlags::CLOEXEC)?)))
    }

    /// Raises the event: one non-blocking write, safe in the tick.
    pub fn raise(&self) {
        // The only possible failure is a full counter, which means raised.
        let _ = rustix::io::write(self.0.as_fd(), &1u64.to_ne_bytes());
    }

    /// Waits until the event is raised or the timeout ends, and lowers it. Returns whether it was raised.
    pub fn wait(&self, timeout: Duration) -> bool {
        let timeout = timespec(timeout);
        let mut fds = [PollFd::new(&*self.0, PollFlags::IN)];
        match poll(&mut fds, Some(&timeout)) {
            Ok(n) if n > 0 => {
                self.lower();
                true
            }
            _ => false,
        }
    }

    /// Same, but also ends when `other` becomes readable or broken; returns whether it did.
    pub fn wait_or_readable(&self, other: BorrowedFd<'_>, timeout: Duration) -> bool {
        let timeout = timespec(timeout);
        let mut fds = [PollFd::new(&*self.0, PollFlags::IN), PollFd::from_borrowed_fd(other, PollFlags::IN)];
        if !poll(&mut fds, Some(&timeout)).is_ok_and(|n| n > 0) {
            return false;
        }
        let [event, other] = fds;
        if !event.revents().is_empty() {
            self.lower();
        }
        !other.revents().is_empty()
    }

    /// Lowers the event without waiting.
    pub fn lower(&self) {
        let _ = rustix::io::read(self.0.as_fd(), &mut [0u8; 8]);
    }
}

fn timespec(duration: Duration) -> Timespec {
    Timespec { tv_sec: duration.as_secs() as i64, tv_nsec: duration.subsec_nanos() as i64 }
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

    #[test]
    fn a_readable_descriptor_ends_a_wait_and_stays_as_it_is() {
        let (wake, other) = (Wake::new().unwrap(), Wake::new().unwrap());
        assert!(!wake.wait_or_readable(other.as_fd(), Duration::ZERO));
        wake.raise();
        assert!(!wake.wait_or_readable(other.as_fd(), Duration::from_secs(1)), "only the event");
        other.raise();
        assert!(wake.wait_or_readable(other.as_fd(), Duration::from_secs(1)));
        assert!(other.wait(Duration::ZERO), "not read by the wait");
    }
}
