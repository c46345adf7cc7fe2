//! Abstract socket names: the kernel gives each to one process at a time, in a network namespace, for all users, and
//! frees it when the process ends, however it ends.

use std::io;
use std::os::fd::{AsFd, AsRawFd};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener, UnixStream};
use std::time::{Duration, Instant};

use rustix::io::Errno;
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType, connect, socket_with};

/// Longest name of a socket in the kernel, without its leading zero [bytes].
const MAX_NAME: usize = 107;
/// How long a process that takes a name may need from binding its socket to listening.
const HOLDER_LIMIT: Duration = Duration::from_millis(500);

/// A process that listens at a socket, as the kernel knows it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Peer {
    /// Process id; 0 if the process is in another pid namespace.
    pub pid: u32,
    /// Its effective user.
    pub uid: u32,
}

/// Why a name cannot be taken.
#[derive(Debug)]
pub enum Taken {
    /// A process has it; `None`: the kernel does not say which.
    By(Option<Peer>),
    /// The kernel refused.
    Io(io::Error),
}

/// Takes a name until the listener is dropped, or returns who has it.
pub fn take(name: &str) -> Result<UnixListener, Taken> {
    let at = SocketAddr::from_abstract_name(name).map_err(Taken::Io)?;
    let deadline = Instant::now() + HOLDER_LIMIT;
    loop {
        match UnixListener::bind_addr(&at) {
            Err(error) if error.kind() == io::ErrorKind::AddrInUse => match holder(name) {
                // The holder has bound its socket and does not listen yet, or has just ended: the next try shows which.
                Err(Errno::CONNREFUSED) if Instant::now() < deadline => std::thread::sleep(Duration::from_millis(1)),
                peer => return Err(Taken::By(peer.ok())),
            },
            bound => return bound.map_err(Taken::Io),
        }
    }
}

/// Returns the process that holds a name. Never blocks; `AGAIN`: it is held, and the queue of connections is full.
pub fn holder(name: &str) -> Result<Peer, Errno> {
    let address = SocketAddrUnix::new_abstract_name(name.as_bytes())?;
    peer(&open(&address)?).map_err(|_| Errno::NOTCONN)
}

/// Connects to an address. Never blocks: `AGAIN` if the queue of connections is full.
pub fn open(address: &SocketAddrUnix) -> Result<UnixStream, Errno> {
    let flags = SocketFlags::NONBLOCK | SocketFlags::CLOEXEC;
    let socket = socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)?;
    connect(socket.as_fd(), address)?;
    Ok(UnixStream::from(socket))
}

/// Returns the process at the other end of a connection, also if it may not be traced.
pub fn peer(stream: impl AsFd) -> io::Result<Peer> {
    // Not rustix: its pid is never 0, and that of a process in another pid namespace is.
    let mut found = libc::ucred { pid: 0, uid: 0, gid: 0 };
    let mut size = size_of::<libc::ucred>() as libc::socklen_t;
    let (fd, to) = (stream.as_fd().as_raw_fd(), (&raw mut found).cast());
    // SAFETY: the kernel writes at most `size` bytes into `found`, which is plain data.
    match unsafe { libc::getsockopt(fd, libc::SOL_SOCKET, libc::SO_PEERCRED, to, &raw mut size) } {
        0 => Ok(Peer { pid: u32::try_from(found.pid).unwrap_or(0), uid: found.uid }),
        _ => Err(io::Error::last_os_error()),
    }
}

/// Shortens a name to what the kernel takes.
pub fn fit(name: String) -> String {
    // Longer names are cut in the middle: hosts differ at the beginning, ports at the end.
    match name.char_indices().nth(MAX_NAME / 2) {
        Some((half, _)) if name.len() > MAX_NAME => {
            let tail = name.char_indices().rev().nth(MAX_NAME / 4).map_or(half, |(at, _)| at);
            format!("{}{}", &name[..half], &name[tail..]).chars().filter(char::is_ascii).collect()
        }
        _ => name,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_holder_that_does_not_listen_yet_is_named() {
        let name = format!("dimos/test/{}", std::process::id());
        let socket = socket_with(AddressFamily::UNIX, SocketType::STREAM, SocketFlags::CLOEXEC, None).unwrap();
        rustix::net::bind(&socket, &SocketAddrUnix::new_abstract_name(name.as_bytes()).unwrap()).unwrap();
        let late = std::thread::spawn(move || {
            std::thread::sleep(Duration::from_millis(50));
            rustix::net::listen(&socket, 8).map(|()| socket).unwrap()
        });
        let Err(Taken::By(Some(peer))) = take(&name) else { panic!("it is held") };
        assert_eq!(peer, Peer { pid: std::process::id(), uid: rustix::process::geteuid().as_raw() });
        drop(late.join().unwrap());
        assert!(take(&name).is_ok(), "the holder has ended");
    }

    #[test]
    fn long_names_fit_and_differ() {
        let long = |end: &str| fit(format!("dimos/device/{}{end}", "h".repeat(300)));
        assert!(long(":1").len() <= MAX_NAME && long("ä").len() <= MAX_NAME);
        assert_ne!(long(":1"), long(":2"));
    }
}
