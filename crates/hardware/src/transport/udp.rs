//! A UDP socket whose datagrams can be captured. All else is the socket's own.

use std::io::Result;
use std::net::{SocketAddr, ToSocketAddrs, UdpSocket};
use std::ops::Deref;
use std::os::fd::{AsFd, BorrowedFd};

use super::capture::Tap;

/// A socket for datagrams.
#[derive(Debug)]
pub struct UdpLink {
    socket: UdpSocket,
    tap: Tap,
}

impl UdpLink {
    /// Binds an address; port 0 is a free one. `name` is the connection's in a capture.
    pub fn bind(address: impl ToSocketAddrs, name: &str) -> Result<Self> {
        let socket = UdpSocket::bind(address)?;
        let port = socket.local_addr()?.port();
        Ok(Self { socket, tap: Tap::open(|| name.to_owned(), true, Some(port)) })
    }

    /// Receives a datagram.
    pub fn recv(&self, buffer: &mut [u8]) -> Result<usize> {
        let length = self.socket.recv(buffer)?;
        self.tap.received(buffer.get(..length).unwrap_or_default());
        Ok(length)
    }

    /// Receives a datagram from anywhere.
    pub fn recv_from(&self, buffer: &mut [u8]) -> Result<(usize, SocketAddr)> {
        let (length, source) = self.socket.recv_from(buffer)?;
        self.tap.received(buffer.get(..length).unwrap_or_default());
        Ok((length, source))
    }

    /// Sends a datagram.
    pub fn send(&self, bytes: &[u8]) -> Result<usize> {
        self.tap.sent(bytes);
        self.socket.send(bytes)
    }
}

impl Deref for UdpLink {
    type Target = UdpSocket;

    fn deref(&self) -> &UdpSocket {
        &self.socket
    }
}

/// Becomes readable when a datagram has arrived.
impl AsFd for UdpLink {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}
