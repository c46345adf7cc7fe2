//! The socket to a peer: bounded connecting, sending and taking lines without waiting.

use std::io::ErrorKind;
use std::net::TcpStream;
use std::ops::Range;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::net::{
    AddressFamily, RecvFlags, SendFlags, Shutdown, SocketAddrUnix, SocketFlags, SocketType, connect, recv, send,
    shutdown, socket_with,
};

use super::address::Address;
use super::protocol::MAX_LINE;
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::transport::capture::Tap;

/// Room for a line and the beginning of the next.
const BUFFER: usize = 2 * MAX_LINE;
/// Reads in one go: a peer that floods us does not keep the thread.
const READS: u32 = 64;

/// A connection over which lines go both ways.
pub struct Link {
    socket: OwnedFd,
    peer: String,
    buffer: Vec<u8>,
    filled: Range<usize>,
    reads: u32,
    tap: Tap,
}

impl Drop for Link {
    /// Ends the connection now. A process that is being started holds every socket for a moment: the peer would find
    /// the connection still open, and refuse the next one.
    fn drop(&mut self) {
        let _ = shutdown(&self.socket, Shutdown::Both);
    }
}

impl Link {
    /// Connects within `timeout`.
    pub fn connect(address: &Address, timeout: Duration) -> AdapterResult<Self> {
        let peer = format!("remote at {address}");
        let socket = match address {
            Address::Unix(path) => unix(path),
            Address::Tcp(address) => TcpStream::connect_timeout(address, timeout).and_then(|stream| {
                stream.set_nodelay(true)?;
                stream.set_nonblocking(true)?;
                Ok(OwnedFd::from(stream))
            }),
        };
        let socket = socket.map_err(|error| {
            let why = match error.kind() {
                ErrorKind::NotFound => "there is no such socket".to_owned(),
                ErrorKind::ConnectionRefused => "connection refused: nothing is listening at this address".to_owned(),
                ErrorKind::PermissionDenied => "it belongs to another user".to_owned(),
                ErrorKind::WouldBlock | ErrorKind::TimedOut => "it takes no more connections".to_owned(),
                _ => error.to_string(),
            };
            AdapterError::Io(format!(
                "cannot connect to {peer}: {why}\nhint: start the process that serves the arm: \
                 python3 dimos_shim.py MODULE:CLASS --at {address}"
            ))
        })?;
        let tap = Tap::open(|| address.to_string(), false, None);
        Ok(Self { socket, peer, buffer: vec![0; BUFFER], filled: 0..0, reads: 0, tap })
    }

    /// Who is at the other end, for messages.
    pub fn peer(&self) -> &str {
        &self.peer
    }

    /// What becomes readable when something has arrived.
    pub fn fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }

    /// Sends a line. A peer that does not take one has stopped reading: that ends the connection.
    pub fn send(&self, line: &[u8]) -> AdapterResult<()> {
        self.tap.sent(line);
        match send(&self.socket, line, SendFlags::DONTWAIT | SendFlags::NOSIGNAL) {
            Ok(n) if n == line.len() => Ok(()),
            Ok(_) | Err(Errno::AGAIN) => Err(AdapterError::Io(format!("{} has stopped taking requests", self.peer))),
            Err(error) => Err(self.broken(error)),
        }
    }

    /// Closes the connection and discards what has not left this computer.
    pub fn abort(self) {
        // Only a TCP socket keeps what it was given; a UNIX socket has handed it over already.
        let _ = rustix::net::sockopt::set_socket_linger(&self.socket, Some(Duration::ZERO));
    }

    /// Waits until something arrives, at most `timeout`.
    pub fn wait(&self, timeout: Duration) {
        let timeout = Timespec { tv_sec: timeout.as_secs() as i64, tv_nsec: timeout.subsec_nanos() as i64 };
        let _ = poll(&mut [PollFd::new(&self.socket, PollFlags::IN)], Some(&timeout));
    }

    /// Begins to take lines: what [`Link::next`] may read is bounded from here on.
    pub fn begin(&mut self) {
        self.reads = READS;
    }

    /// The next line that has arrived, without its end; never waits.
    pub fn next(&mut self) -> AdapterResult<Option<&[u8]>> {
        let length = loop {
            let bytes = self.buffer.get(self.filled.clone()).unwrap_or_default();
            match bytes.iter().position(|byte| *byte == b'\n') {
                Some(length) => break length,
                None if bytes.len() > MAX_LINE => return Err(self.nonsense("a line without end")),
                None if self.reads == 0 || !self.fill()? => return Ok(None),
                None => self.reads -= 1,
            }
        };
        let start = self.filled.start;
        self.filled.start += length + 1;
        Ok(self.buffer.get(start..start + length))
    }

    /// What was received is not of this protocol. That ends the connection: on a local socket nothing is damaged on
    /// its way, so the other end speaks something else.
    pub fn nonsense(&self, what: &str) -> AdapterError {
        AdapterError::Protocol(format!(
            "{} does not speak this protocol: {what}\n\
             hint: is dimos_shim.py what listens there? docs/remote-adapter.md has the protocol",
            self.peer
        ))
    }

    /// Reads what has arrived; `false` when there is nothing.
    fn fill(&mut self) -> AdapterResult<bool> {
        self.buffer.copy_within(self.filled.clone(), 0);
        self.filled = 0..self.filled.len();
        let room = self.buffer.get_mut(self.filled.end..).unwrap_or_default();
        match recv(&self.socket, &mut *room, RecvFlags::DONTWAIT) {
            Ok((0, _)) => Err(AdapterError::Io(format!("{} closed the connection", self.peer))),
            Ok((n, _)) => {
                self.tap.received(room.get(..n).unwrap_or_default());
                self.filled.end += n;
                Ok(true)
            }
            Err(Errno::AGAIN | Errno::INTR) => Ok(false),
            Err(error) => Err(self.broken(error)),
        }
    }

    fn broken(&self, error: Errno) -> AdapterError {
        let why = match error {
            Errno::PIPE | Errno::CONNRESET => "closed the connection".to_owned(),
            _ => format!("is no longer reachable: {error}"),
        };
        AdapterError::Io(format!("{} {why}", self.peer))
    }
}

/// Connects without waiting: a Unix socket takes a connection at once, or its queue is full.
fn unix(path: &std::path::Path) -> std::io::Result<OwnedFd> {
    let flags = SocketFlags::NONBLOCK | SocketFlags::CLOEXEC;
    let socket = socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)?;
    connect(&socket, &SocketAddrUnix::new(path)?)?;
    Ok(socket)
}
