//! A TCP connection to a controller: connect and wait with timeouts, frames from a byte stream.

use std::io::{ErrorKind, Read, Write};
use std::net::{IpAddr, Ipv6Addr, SocketAddr, TcpStream, ToSocketAddrs};
use std::os::fd::{AsFd, BorrowedFd};
use std::sync::mpsc;
use std::time::{Duration, Instant};

use super::capture::Tap;
use super::incoming::Incoming;
pub use super::incoming::Scan;
use crate::adapter::{AdapterError, AdapterResult};

/// A peer that acknowledges nothing for this time is lost [ms].
const USER_TIMEOUT_MS: u32 = 1000;

/// Maximum number of reads in search of a frame that is not waited for: endless noise must not block the caller.
const MAX_READS: usize = 16;

/// Address of a controller.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Endpoint {
    /// IPv4 or IPv6 address, or a name.
    pub host: String,
    /// TCP port.
    pub port: u16,
}

impl Endpoint {
    /// Parses `HOST[:PORT]`; an IPv6 address with a port is in brackets. Does not use the network.
    pub fn parse(address: &str, default_port: u16) -> Result<Self, String> {
        let (host, port) = if let Some(rest) = address.strip_prefix('[') {
            let (host, port) = rest.split_once(']').ok_or_else(|| format!("{address:?} lacks the closing bracket"))?;
            host.parse::<Ipv6Addr>().map_err(|_| format!("{host:?} is not an IPv6 address"))?;
            match port {
                "" => (host, None),
                _ => (host, Some(port.strip_prefix(':').ok_or_else(|| format!("{port:?} is not a port"))?)),
            }
        } else if address.parse::<Ipv6Addr>().is_ok() {
            (address, None)
        } else {
            match address.split_once(':') {
                Some((host, port)) => (host, Some(port)),
                None => (address, None),
            }
        };
        if host.is_empty() {
            return Err("the host is missing".into());
        }
        let is_name = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '.' | '_');
        let numeric = host.chars().all(|c| c.is_ascii_digit() || c == '.');
        if host.parse::<IpAddr>().is_err() && (numeric || !host.chars().all(is_name)) {
            return Err(format!("{host:?} is neither an IP address nor a host name"));
        }
        let port = match port {
            None => default_port,
            Some(text) => match text.parse() {
                Ok(port) if port != 0 => port,
                _ => return Err(format!("{text:?} is not a port (1 to 65535)")),
            },
        };
        Ok(Self { host: host.to_owned(), port })
    }

    /// Resolves the name within `timeout`.
    fn resolve(&self, timeout: Duration) -> Result<SocketAddr, String> {
        if let Ok(ip) = self.host.parse::<IpAddr>() {
            return Ok(SocketAddr::new(ip, self.port));
        }
        // The system's resolver has no timeout, so it runs in a separate thread, abandoned when it is late.
        let (sender, receiver) = mpsc::channel();
        let target = (self.host.clone(), self.port);
        std::thread::Builder::new()
            .name("resolve".into())
            .spawn(move || drop(sender.send(target.to_socket_addrs().map(|mut found| found.next()))))
            .map_err(|e| e.to_string())?;
        match receiver.recv_timeout(timeout) {
            Ok(Ok(Some(address))) => Ok(address),
            Ok(_) => Err("the host name is not known".into()),
            Err(_) => Err("looking up the host name took too long".into()),
        }
    }
}

impl std::fmt::Display for Endpoint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { host, port } = self;
        if host.contains(':') { write!(f, "[{host}]:{port}") } else { write!(f, "{host}:{port}") }
    }
}

/// A connection with frames in both directions.
#[derive(Debug)]
pub struct TcpLink {
    stream: TcpStream,
    peer: String,
    incoming: Incoming,
    /// Timeout of reads.
    timeout: Duration,
    tap: Tap,
}

impl TcpLink {
    /// Connects within `timeout`, including name resolution. `device` names the arm in messages.
    pub fn connect(device: &str, endpoint: &Endpoint, timeout: Duration) -> AdapterResult<Self> {
        let failed = |why: String| AdapterError::Io(format!("cannot connect to {device} at {endpoint}: {why}"));
        let deadline = Instant::now() + timeout;
        let address = endpoint.resolve(timeout).map_err(failed)?;
        let left = deadline.saturating_duration_since(Instant::now()).max(Duration::from_millis(1));
        let stream = TcpStream::connect_timeout(&address, left).map_err(|e| match e.kind() {
            ErrorKind::TimedOut => {
                AdapterError::Timeout(format!("cannot connect to {device} at {endpoint}: no answer within {timeout:?}"))
            }
            _ => failed(reason(&e)),
        })?;
        let prepare = || -> std::io::Result<()> {
            stream.set_nodelay(true)?;
            stream.set_read_timeout(Some(timeout))?;
            stream.set_write_timeout(Some(timeout))?;
            rustix::net::sockopt::set_socket_keepalive(&stream, true)?;
            rustix::net::sockopt::set_tcp_keepidle(&stream, Duration::from_secs(1))?;
            rustix::net::sockopt::set_tcp_keepintvl(&stream, Duration::from_secs(1))?;
            rustix::net::sockopt::set_tcp_user_timeout(&stream, USER_TIMEOUT_MS)?;
            Ok(())
        };
        prepare().map_err(|e| failed(reason(&e)))?;
        let peer = format!("{device} at {endpoint}");
        let tap = Tap::open(|| endpoint.to_string(), false, None);
        Ok(Self { stream, peer, incoming: Incoming::new(), timeout, tap })
    }

    /// Returns the device and its address, for messages.
    pub fn peer(&self) -> &str {
        &self.peer
    }

    /// Returns the addresses of this side and of the peer.
    pub fn addresses(&self) -> std::io::Result<(SocketAddr, SocketAddr)> {
        Ok((self.stream.local_addr()?, self.stream.peer_addr()?))
    }

    /// Sends all of `bytes`.
    pub fn send(&mut self, bytes: &[u8]) -> AdapterResult<()> {
        self.tap.sent(bytes);
        self.stream.write_all(bytes).map_err(|e| broken(&self.peer, &e))
    }

    /// Sends as much of `bytes` as possible without blocking. For a last message before [`TcpLink::abort`].
    pub fn send_now(&mut self, bytes: &[u8]) {
        self.tap.sent(bytes);
        let flags = rustix::net::SendFlags::DONTWAIT | rustix::net::SendFlags::NOSIGNAL;
        let _ = rustix::net::send(&self.stream, bytes, flags);
    }

    /// Closes the connection and discards unsent bytes (linger 0: the peer sees a reset). After a plain drop the kernel
    /// would continue to send them. Never blocks.
    pub fn abort(self) {
        // If the option is refused, the connection is broken already and sends nothing more.
        let _ = rustix::net::sockopt::set_socket_linger(&self.stream, Some(Duration::ZERO));
    }

    /// Waits up to `timeout` for a frame. `scan` gets the received bytes from the first one on, until it takes a frame;
    /// it must skip everything else. `Timeout` leaves the connection usable; `Io` does not.
    pub fn receive<T>(&mut self, timeout: Duration, scan: impl FnMut(&[u8]) -> Scan<T>) -> AdapterResult<T> {
        let Self { stream, peer, incoming, timeout: set, tap } = self;
        incoming.receive(peer, timeout, scan, |room, left| {
            if left.is_zero() {
                return read_now(stream, peer, room, *tap);
            }
            if *set != left {
                stream.set_read_timeout(Some(left)).map_err(|e| broken(peer, &e))?;
                *set = left;
            }
            match stream.read(room) {
                Ok(0) => Err(AdapterError::Io(format!("{peer} closed the connection"))),
                Ok(n) => {
                    tap.received(room.get(..n).unwrap_or_default());
                    Ok(n)
                }
                Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted) => {
                    Ok(0)
                }
                Err(e) => Err(broken(peer, &e)),
            }
        })
    }

    /// Discards everything received so far.
    pub fn drain(&mut self) -> AdapterResult<()> {
        self.incoming.clear();
        let mut room = [0; 1024];
        for _ in 0..MAX_READS {
            if read_now(&self.stream, &self.peer, &mut room, self.tap)? == 0 {
                break;
            }
        }
        Ok(())
    }

    /// Returns the next frame among the received bytes, without waiting; `None` if there is none, or if too much noise
    /// comes before it: the connection is still readable then. `scan` as above.
    pub fn poll<T>(&mut self, mut scan: impl FnMut(&[u8]) -> Scan<T>) -> AdapterResult<Option<T>> {
        let Self { stream, peer, incoming, tap, .. } = self;
        for _ in 0..MAX_READS {
            if let Some(frame) = incoming.next(&mut scan) {
                return Ok(Some(frame));
            }
            let arrived = incoming.fill(peer, |room| read_now(stream, peer, room, *tap))?;
            if arrived == 0 {
                return Ok(None);
            }
        }
        Ok(incoming.next(&mut scan))
    }
}

/// Reads what has arrived; 0 if nothing has.
fn read_now(stream: &TcpStream, peer: &str, room: &mut [u8], tap: Tap) -> AdapterResult<usize> {
    match rustix::net::recv(stream, &mut *room, rustix::net::RecvFlags::DONTWAIT) {
        Ok((0, _)) => Err(AdapterError::Io(format!("{peer} closed the connection"))),
        Ok((n, _)) => {
            tap.received(room.get(..n).unwrap_or_default());
            Ok(n)
        }
        Err(rustix::io::Errno::AGAIN | rustix::io::Errno::INTR) => Ok(0),
        Err(e) => Err(broken(peer, &e.into())),
    }
}

/// Becomes readable when bytes have arrived.
impl AsFd for TcpLink {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.stream.as_fd()
    }
}

fn broken(peer: &str, error: &std::io::Error) -> AdapterError {
    AdapterError::Io(format!("the connection to {peer} broke: {}", reason(error)))
}

/// Describes an I/O error without the system's number.
fn reason(error: &std::io::Error) -> String {
    match error.kind() {
        ErrorKind::ConnectionRefused => "connection refused".into(),
        ErrorKind::ConnectionReset => "connection reset".into(),
        ErrorKind::BrokenPipe | ErrorKind::ConnectionAborted => "connection closed".into(),
        ErrorKind::HostUnreachable => "host unreachable".into(),
        ErrorKind::NetworkUnreachable => "network unreachable".into(),
        ErrorKind::TimedOut | ErrorKind::WouldBlock => "no answer".into(),
        _ => error.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::super::incoming::BUFFER;
    use super::*;
    use std::net::TcpListener;

    #[test]
    fn addresses() {
        let ok = |text| Endpoint::parse(text, 9760).map(|e| e.to_string());
        assert_eq!(ok("192.168.1.100"), Ok("192.168.1.100:9760".into()));
        assert_eq!(ok("arm-1.local:77"), Ok("arm-1.local:77".into()));
        assert_eq!(ok("::1"), Ok("[::1]:9760".into()));
        assert_eq!(ok("[fe80::2]:80"), Ok("[fe80::2]:80".into()));
        for bad in ["", ":80", "300.1.1.1", "1.2.3", "a b", "host:0", "host:99999", "host:", "[::1", "[::1]80", "a/b"] {
            assert!(Endpoint::parse(bad, 9760).is_err(), "{bad:?}");
        }
    }

    /// A peer that sends `pieces` one by one and then keeps the connection open until the client closes it.
    fn peer(pieces: Vec<Vec<u8>>) -> Endpoint {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            for piece in pieces {
                stream.write_all(&piece).unwrap();
                std::thread::sleep(Duration::from_millis(5));
            }
            let _ = stream.read(&mut [0; 1]);
        });
        Endpoint { host: "127.0.0.1".into(), port }
    }

    /// Frames of three bytes that begin with `#`.
    fn scan(bytes: &[u8]) -> Scan<Vec<u8>> {
        match bytes {
            [b'#', _, _, ..] => Scan::Take(3, bytes[..3].to_vec()),
            [b'#', ..] => Scan::More,
            _ => Scan::Skip(1),
        }
    }

    #[test]
    fn frames_arrive_in_pieces_and_among_noise() {
        let pieces = [&b"xx#"[..], b"a", b"b#cd!!!", b"#e"].map(<[u8]>::to_vec).to_vec();
        let mut link = TcpLink::connect("test", &peer(pieces), Duration::from_secs(2)).unwrap();
        let wait = Duration::from_secs(5);
        assert_eq!(link.receive(wait, scan), Ok(b"#ab".to_vec()));
        assert_eq!(link.receive(wait, scan), Ok(b"#cd".to_vec()));
        let late = link.receive(Duration::from_millis(20), scan);
        assert!(matches!(late, Err(AdapterError::Timeout(_))), "{late:?}");
    }

    #[test]
    fn what_has_arrived_counts_when_the_time_is_over() {
        let mut link = TcpLink::connect("test", &peer(vec![b"#ab".to_vec()]), Duration::from_secs(2)).unwrap();
        std::thread::sleep(Duration::from_millis(100));
        assert_eq!(link.receive(Duration::ZERO, scan), Ok(b"#ab".to_vec()));
        assert!(matches!(link.receive(Duration::ZERO, scan), Err(AdapterError::Timeout(_))));
    }

    #[test]
    fn received_bytes_can_be_discarded() {
        let pieces = [&b"#ab#c"[..], b"d#ef"].map(<[u8]>::to_vec).to_vec();
        let mut link = TcpLink::connect("test", &peer(pieces), Duration::from_secs(2)).unwrap();
        assert_eq!(link.receive(Duration::from_secs(5), scan), Ok(b"#ab".to_vec()));
        std::thread::sleep(Duration::from_millis(100));
        link.drain().unwrap();
        assert!(matches!(link.receive(Duration::from_millis(20), scan), Err(AdapterError::Timeout(_))));
    }

    #[test]
    fn a_frame_without_end_is_an_error_not_a_hang() {
        let endless = vec![b'#'; BUFFER];
        let mut link = TcpLink::connect("test", &peer(vec![endless]), Duration::from_secs(2)).unwrap();
        let result = link.receive::<()>(Duration::from_secs(5), |_| Scan::More);
        assert!(matches!(result, Err(AdapterError::Protocol(_))), "{result:?}");
    }

    #[test]
    fn endless_noise_does_not_block_a_poll() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let endpoint = Endpoint { host: "127.0.0.1".into(), port: listener.local_addr().unwrap().port() };
        let mut link = TcpLink::connect("test", &endpoint, Duration::from_secs(5)).unwrap();
        let (mut peer, _) = listener.accept().unwrap();
        let noise = std::thread::spawn(move || while peer.write_all(&[b'x'; BUFFER]).is_ok() {});
        link.receive(Duration::from_secs(10), |bytes| Scan::Take(bytes.len(), ())).unwrap();
        std::thread::sleep(Duration::from_millis(20));
        let mut scans = 0;
        let found = link.poll(|bytes| {
            scans += 1;
            assert!(scans <= 10 * MAX_READS, "the poll does not end");
            // More noise arrives meanwhile.
            std::thread::sleep(Duration::from_millis(2));
            Scan::<()>::Skip(bytes.len())
        });
        assert_eq!(found, Ok(None));
        drop(link);
        noise.join().unwrap();
    }

    /// What a slow peer finally receives: the number of bytes sent and received, and how the connection ended.
    fn received_after(close: impl FnOnce(TcpLink)) -> (usize, usize, std::io::Result<usize>) {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let endpoint = Endpoint { host: "127.0.0.1".into(), port: listener.local_addr().unwrap().port() };
        let mut link = TcpLink::connect("test", &endpoint, Duration::from_secs(5)).unwrap();
        let (mut peer, _) = listener.accept().unwrap();
        rustix::net::sockopt::set_socket_send_buffer_size(&link.stream, 1 << 20).unwrap();
        link.stream.set_nonblocking(true).unwrap();
        let mut sent = 0;
        while let Ok(n) = link.stream.write(&[1; 4096]) {
            sent += n;
        }
        close(link);
        let (mut received, mut buffer) = (0, vec![0; 1 << 16]);
        peer.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        loop {
            match peer.read(&mut buffer) {
                Ok(n @ 1..) => received += n,
                end => return (sent, received, end),
            }
        }
    }

    #[test]
    fn what_has_not_left_is_discarded_by_an_abort_and_sent_by_a_drop() {
        let (sent, received, end) = received_after(TcpLink::abort);
        assert!(received < sent, "{received} of {sent} bytes");
        assert_eq!(end.unwrap_err().kind(), ErrorKind::ConnectionReset);
        let (sent, received, end) = received_after(drop);
        assert_eq!((received, end.unwrap()), (sent, 0));
    }

    #[test]
    fn failures_say_who_and_why() {
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let nobody = Endpoint { host: "127.0.0.1".into(), port };
        let error = TcpLink::connect("yourarm", &nobody, Duration::from_secs(1)).unwrap_err();
        let expected = format!("cannot connect to yourarm at 127.0.0.1:{port}: connection refused");
        assert_eq!(error.to_string(), expected);
    }
}
