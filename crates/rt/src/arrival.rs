//! When the kernel received what was read from a socket: without the time that the reader took to wake.

use std::io;
use std::os::fd::{AsRawFd, BorrowedFd};

use dimos_core::clock::{Clock, Mono, MonotonicClock, wall_now};

/// Longest plausible age of a packet that was just read [ns]; a step of the wall clock is not taken for an age.
const MAX_AGE: u64 = 100_000_000;

/// Returns when the packet arrived that was read last from a socket. The kernel notes that from shortly after the first
/// call on; for a packet before that, or if the wall clock was set meanwhile, it is when it was read.
///
/// # Errors
/// If the descriptor is no socket, or nothing was read from it yet.
pub fn of_last_packet(socket: BorrowedFd<'_>) -> io::Result<Mono> {
    // SAFETY: timespec is plain data, zero is a valid value for it.
    let mut stamp: libc::timespec = unsafe { std::mem::zeroed() };
    // SAFETY: the descriptor is open as long as it is borrowed; the kernel writes one timespec.
    if unsafe { libc::ioctl(socket.as_raw_fd(), SIOCGSTAMPNS, &raw mut stamp) } != 0 {
        return Err(io::Error::last_os_error());
    }
    let now = MonotonicClock.now();
    let arrived = stamp.tv_sec as u64 * 1_000_000_000 + stamp.tv_nsec as u64;
    let age = wall_now().checked_sub(arrived).filter(|age| *age <= MAX_AGE).unwrap_or_default();
    Ok(Mono(now.0.saturating_sub(age)))
}

/// The request for it: `linux/sockios.h`.
const SIOCGSTAMPNS: libc::c_ulong = 0x8907;

#[cfg(test)]
mod tests {
    use super::*;
    use std::net::UdpSocket;
    use std::os::fd::AsFd;
    use std::time::Duration;

    #[test]
    fn a_packet_that_waited_is_as_old_as_it_is() {
        let (one, other) = (UdpSocket::bind("127.0.0.1:0").unwrap(), UdpSocket::bind("127.0.0.1:0").unwrap());
        assert!(of_last_packet(one.as_fd()).is_err(), "nothing was read");
        let mut buffer = [0; 8];
        let mut age = |wait: u64| {
            let before = MonotonicClock.now();
            other.send_to(&[1], one.local_addr().unwrap()).unwrap();
            let sent = MonotonicClock.now();
            std::thread::sleep(Duration::from_millis(wait));
            one.recv_from(&mut buffer).unwrap();
            (before, of_last_packet(one.as_fd()).unwrap(), sent)
        };
        // The kernel begins to note it some time after it was asked.
        let read = |(_, arrived, sent): &(Mono, Mono, Mono)| arrived.since(*sent) > Duration::from_millis(10);
        let (before, arrived, sent) = std::iter::repeat_with(|| age(20)).take(100).find(|one| !read(one)).unwrap();
        // The wall clock is adjusted by up to 500 ppm.
        let slack = Duration::from_micros(50);
        assert!(before <= arrived.after(slack) && arrived <= sent.after(slack), "{before:?} {arrived:?} {sent:?}");
    }
}
