//! One program per device: an abstract socket name for each address that the device's address resolves to, bound before
//! a byte is sent. It is valid for all users of this computer, and ends with the process.

use std::collections::BTreeSet;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr as SocketIp, ToSocketAddrs};
use std::os::fd::AsFd;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener};
use std::sync::mpsc;
use std::time::{Duration, Instant};

use rustix::io::Errno;
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType, connect, socket_with, sockopt};

/// Longest name of a socket in the kernel, without its leading zero [bytes].
const MAX_NAME: usize = 107;
/// Timeout for the lookup of a host name.
const LOOK_UP_LIMIT: Duration = Duration::from_secs(3);
/// How long a process that takes a name may need from binding its socket to listening.
const HOLDER_LIMIT: Duration = Duration::from_millis(500);

/// A lock on devices, held for the lifetime of this value.
#[derive(Debug)]
pub struct DeviceLock(#[expect(dead_code, reason = "the names are ours while the sockets are open")] Vec<UnixListener>);

/// Why a device cannot be locked.
#[derive(Debug, thiserror::Error)]
pub enum DeviceLockError {
    /// Another process holds it.
    #[error("{adapter} at {address} is in use by process {pid}")]
    By {
        /// The adapter.
        adapter: String,
        /// The device's address.
        address: String,
        /// The process.
        pid: String,
    },
    /// The name cannot be bound.
    #[error("cannot lock {adapter} at {address}: {error}")]
    Io {
        /// The adapter.
        adapter: String,
        /// The device's address.
        address: String,
        /// The error.
        error: io::Error,
    },
}

/// Locks the device at a complete address; the error names the process that holds it. Resolves host names.
pub fn take(adapter: &str, address: &str) -> Result<DeviceLock, DeviceLockError> {
    let names = canonical_addresses(address).into_iter().map(|place| name(adapter, &place));
    let mut taken = Vec::new();
    for name in names {
        let (adapter, address) = (adapter.to_owned(), address.to_owned());
        taken.push(take_name(&name).map_err(|refused| match refused {
            Refused::Taken(pid) => {
                let pid = pid.map_or_else(|| "unknown".to_owned(), |pid| pid.to_string());
                DeviceLockError::By { adapter, address, pid }
            }
            Refused::Io(error) => DeviceLockError::Io { adapter, address, error },
        })?);
    }
    Ok(DeviceLock(taken))
}

/// Why a name cannot be taken.
enum Refused {
    /// A process has it; its pid where the kernel knows it.
    Taken(Option<i32>),
    /// The kernel refused.
    Io(io::Error),
}

/// Takes the name, or returns who has it.
fn take_name(name: &str) -> Result<UnixListener, Refused> {
    let at = SocketAddr::from_abstract_name(name).map_err(Refused::Io)?;
    let deadline = Instant::now() + HOLDER_LIMIT;
    loop {
        match UnixListener::bind_addr(&at) {
            Err(error) if error.kind() == io::ErrorKind::AddrInUse => match holder(name) {
                // The holder has bound its socket and does not listen yet, or has just ended: the next try shows which.
                Err(Errno::CONNREFUSED) if Instant::now() < deadline => std::thread::sleep(Duration::from_millis(1)),
                pid => return Err(Refused::Taken(pid.ok())),
            },
            bound => return bound.map_err(Refused::Io),
        }
    }
}

/// Returns the pid that holds the name, taken from the socket's peer credentials. Never blocks.
fn holder(name: &str) -> Result<i32, Errno> {
    let flags = SocketFlags::NONBLOCK | SocketFlags::CLOEXEC;
    let socket = socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)?;
    connect(socket.as_fd(), &SocketAddrUnix::new_abstract_name(name.as_bytes())?)?;
    Ok(sockopt::socket_peercred(&socket)?.pid.as_raw_nonzero().get())
}

/// Returns canonical addresses of a device, the same for every spelling: the addresses of its host, each with the first
/// port, or the device file behind a link. At least one.
fn canonical_addresses(address: &str) -> BTreeSet<String> {
    let text = address.trim();
    if text.starts_with("memory:") {
        // A bus in memory belongs to its process: others have their own with the same number.
        return BTreeSet::from([format!("{text} of process {}", std::process::id())]);
    }
    // Names of serial devices may contain colons: `/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0-port0`.
    if text.starts_with('/') {
        return BTreeSet::from([device_file(text)]);
    }
    if let Some((kind, path)) = text.split_once(':').filter(|(_, path)| path.starts_with('/')) {
        return BTreeSet::from([format!("{}:{}", kind.to_ascii_lowercase(), device_file(path))]);
    }
    let text = text.to_ascii_lowercase();
    let Some((host, port)) = host_and_port(text.strip_prefix("tcp:").unwrap_or(&text)) else {
        return BTreeSet::from([text]);
    };
    let ips = match host.parse::<IpAddr>() {
        Ok(ip) => vec![ip],
        Err(_) => look_up(host, port),
    };
    if ips.is_empty() {
        // An unknown host name cannot be reached either.
        return BTreeSet::from([format!("{host}:{port}")]);
    }
    ips.into_iter().map(|ip| SocketIp::new(canonical(ip), port).to_string()).collect()
}

/// Returns the device file behind `PATH[@RATE]`; the path itself if there is no such file.
fn device_file(text: &str) -> String {
    let path = text.rsplit_once('@').map_or(text, |(path, _)| path);
    std::fs::canonicalize(path).map_or_else(|_| path.to_owned(), |real| real.display().to_string())
}

/// Returns host and first port of `HOST:PORT` or `[HOST]:PORT`; further ports belong to the same device.
fn host_and_port(text: &str) -> Option<(&str, u16)> {
    let (host, ports) = match text.strip_prefix('[') {
        Some(rest) => rest.split_once("]:")?,
        None => text.split_once(':')?,
    };
    let port = ports.split(':').next()?.parse().ok()?;
    Some((host, port))
}

/// Returns the canonical form of an address: IPv4 for IPv4-mapped ones, the loopback address for "this host".
fn canonical(ip: IpAddr) -> IpAddr {
    match ip.to_canonical() {
        IpAddr::V4(v4) if v4.is_unspecified() => Ipv4Addr::LOCALHOST.into(),
        IpAddr::V6(v6) if v6.is_unspecified() => Ipv6Addr::LOCALHOST.into(),
        other => other,
    }
}

/// Returns all addresses of a host name; none if it is unknown or the lookup times out.
fn look_up(host: &str, port: u16) -> Vec<IpAddr> {
    // The system's resolver has no deadline, so it runs on its own thread, which is abandoned at the timeout.
    let (sender, found) = mpsc::channel();
    let target = (host.to_owned(), port);
    let asked = std::thread::Builder::new().name("resolve".into()).spawn(move || {
        let found = target.to_socket_addrs().map(|all| all.map(|address| address.ip()).collect());
        drop(sender.send(found.unwrap_or_default()));
    });
    asked.ok().and_then(|_| found.recv_timeout(LOOK_UP_LIMIT).ok()).unwrap_or_default()
}

/// Returns the socket name.
fn name(adapter: &str, place: &str) -> String {
    let name = format!("dimos/device/{adapter}/{place}");
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
    fn f29_a_device_is_taken_once_and_names_the_holder() {
        let port = std::process::id();
        let at = |host: &str| format!("{host}:{port}");
        let held = take("test", &at("LOCALHOST")).unwrap();
        for _ in 0..200 {
            let refused = take("test", &at("127.0.0.1")).unwrap_err().to_string();
            // The queue of connections fills up; then no process is named, and the call does not block.
            assert!(refused.contains(&format!("process {port}")) || refused.contains("unknown"), "{refused}");
        }
        assert!(take("test", &at("127.0.0.2")).is_ok());
        assert!(take("other", &at("127.0.0.1")).is_ok());
        drop(held);
        assert!(take("test", &at("127.0.0.1")).is_ok());
    }

    #[test]
    fn a_holder_that_does_not_listen_yet_is_named() {
        let (port, name) = (std::process::id(), name("starting", &format!("127.0.0.1:{}", std::process::id())));
        let flags = SocketFlags::CLOEXEC;
        let socket = socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None).unwrap();
        rustix::net::bind(&socket, &SocketAddrUnix::new_abstract_name(name.as_bytes()).unwrap()).unwrap();
        let late = std::thread::spawn(move || {
            std::thread::sleep(Duration::from_millis(50));
            rustix::net::listen(&socket, 8).map(|()| socket).unwrap()
        });
        let refused = take("starting", &format!("127.0.0.1:{port}")).unwrap_err().to_string();
        assert!(refused.contains(&format!("in use by process {port}")), "{refused}");
        drop(late.join().unwrap());
        assert!(take("starting", &format!("127.0.0.1:{port}")).is_ok(), "the holder has ended");
    }

    #[test]
    fn names_fit_and_differ_by_host_and_port() {
        let all = |address: &str| canonical_addresses(address).iter().map(|place| name("a", place)).collect::<Vec<_>>();
        let long = |end: &str| name("adapter", &format!("{}{end}", "h".repeat(300)));
        assert!(long(":1").len() <= MAX_NAME && long("ä").len() <= MAX_NAME);
        assert_ne!(long(":1"), long(":2"));
        assert_eq!(all("Host.invalid:1"), all(" host.invalid:1"));
    }

    #[test]
    fn every_spelling_of_an_address_is_the_same_device() {
        let same = |spellings: &[&str]| {
            let first = canonical_addresses(spellings[0]);
            spellings.iter().for_each(|other| assert_eq!(canonical_addresses(other), first, "{other}"));
            first
        };
        let v4 = same(&[
            "127.0.0.65:502:30000",
            "[::ffff:127.0.0.65]:502:30000",
            "[::FFFF:7f00:41]:502",
            "tcp:127.0.0.65:502",
        ]);
        assert_eq!(v4, BTreeSet::from(["127.0.0.65:502".to_owned()]));
        same(&["[fe80::2]:502", "[FE80:0:0:0::2]:502:31000"]);
        assert!(canonical_addresses("localhost:9").is_superset(&canonical_addresses("127.0.0.1:9")));
        assert_eq!(canonical_addresses("0.0.0.0:9"), canonical_addresses("127.0.0.1:9"));
        assert_ne!(canonical_addresses("127.0.0.1:9"), canonical_addresses("127.0.0.1:10"));
        assert_eq!((canonical_addresses("can0").len(), canonical_addresses("CAN0").len()), (1, 1));
        let folder = tempfile::tempdir().unwrap();
        let (device, link) = (folder.path().join("ttyACM0"), folder.path().join("by-id"));
        std::fs::write(&device, "").unwrap();
        std::os::unix::fs::symlink(&device, &link).unwrap();
        let at = |path: &std::path::Path, rate: &str| format!("slcan:{}{rate}", path.display());
        same(&[&at(&device, "@1000000"), &at(&link, "@1000000"), &at(&link, "@500000")]);
        let by_path = folder.path().join("pci-0000:00:14.0-usb-0:1:1.0-port0");
        std::os::unix::fs::symlink(&device, &by_path).unwrap();
        let at = |path: &std::path::Path, rate: &str| format!("{}{rate}", path.display());
        let port = same(&[&at(&device, "@1000000"), &at(&device, ""), &at(&link, "@500000"), &at(&by_path, "@9600")]);
        assert_eq!(port, BTreeSet::from([std::fs::canonicalize(&device).unwrap().display().to_string()]));
        // A port that is unplugged.
        same(&["/dev/serial/by-path/pci-0000:00:14.0@9600", "/dev/serial/by-path/pci-0000:00:14.0"]);
    }
}
