//! One program per device: a name in the kernel by the device's canonical address, taken before a byte is sent. It
//! belongs to the machine, not to a user or a folder, and dies with the process.

use std::io;
use std::os::fd::AsFd;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener};

use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType, connect, socket_with, sockopt};

/// Longest name of a socket in the kernel, without its leading zero [bytes].
const MAX_NAME: usize = 107;

/// A device that is ours for as long as this lives.
#[derive(Debug)]
pub struct DeviceLock(#[expect(dead_code, reason = "the name is ours while the socket is open")] UnixListener);

/// Why a device is not ours.
#[derive(Debug, thiserror::Error)]
pub enum DeviceTaken {
    /// Another process has it.
    #[error("{adapter} at {address} is in use by process {pid}")]
    By {
        /// The adapter.
        adapter: String,
        /// The device's address.
        address: String,
        /// The process.
        pid: String,
    },
    /// The name cannot be taken.
    #[error("cannot lock {adapter} at {address}: {error}")]
    Io {
        /// The adapter.
        adapter: String,
        /// The device's address.
        address: String,
        /// Why.
        error: io::Error,
    },
}

/// Takes the device at an address, which is given in full, or says who has it.
pub fn take(adapter: &str, address: &str) -> Result<DeviceLock, DeviceTaken> {
    let name = name(adapter, address);
    let bound = SocketAddr::from_abstract_name(&name).and_then(|at| UnixListener::bind_addr(&at));
    let (adapter, address) = (adapter.to_owned(), address.to_owned());
    bound.map(DeviceLock).map_err(|error| match error.kind() {
        io::ErrorKind::AddrInUse => {
            let pid = holder(&name).map_or_else(|| "unknown".to_owned(), |pid| pid.to_string());
            DeviceTaken::By { adapter, address, pid }
        }
        _ => DeviceTaken::Io { adapter, address, error },
    })
}

/// Who has a name: the kernel tells whoever connects. Waits for nobody.
fn holder(name: &str) -> Option<i32> {
    let flags = SocketFlags::NONBLOCK | SocketFlags::CLOEXEC;
    let socket = socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None).ok()?;
    connect(socket.as_fd(), &SocketAddrUnix::new_abstract_name(name.as_bytes()).ok()?).ok()?;
    Some(sockopt::socket_peercred(&socket).ok()?.pid.as_raw_nonzero().get())
}

/// The same for every spelling of a device's address: case, a name for the loopback.
fn name(adapter: &str, address: &str) -> String {
    let address = address.trim().to_ascii_lowercase().replace("localhost", "127.0.0.1");
    let name = format!("dimos/device/{adapter}/{address}");
    // Hosts may have names longer than that; they differ at their beginning, ports at their end.
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
    fn f29_a_device_is_taken_once_and_names_the_holder() {
        let port = std::process::id();
        let at = |host: &str| format!("{host}:{port}");
        let held = take("test", &at("LOCALHOST")).unwrap();
        for _ in 0..200 {
            let refused = take("test", &at("127.0.0.1")).unwrap_err().to_string();
            // A queue of those who ask is full some time: then nobody is named, and nobody waits.
            assert!(refused.contains(&format!("process {port}")) || refused.contains("unknown"), "{refused}");
        }
        assert!(take("test", &at("127.0.0.2")).is_ok());
        assert!(take("other", &at("127.0.0.1")).is_ok());
        drop(held);
        assert!(take("test", &at("127.0.0.1")).is_ok());
    }

    #[test]
    fn names_fit_and_differ_by_host_and_port() {
        let long = |end: &str| name("adapter", &format!("{}{end}", "h".repeat(300)));
        assert!(long(":1").len() <= MAX_NAME && long("ä").len() <= MAX_NAME);
        assert_ne!(long(":1"), long(":2"));
        assert_eq!(name("a", "Host:1"), name("a", " host:1"));
    }
}
