//! One program per device: an abstract socket name for each address that the device's address resolves to, bound before
//! a byte is sent. It is valid for all users of this computer, and ends with the process.

use std::collections::BTreeSet;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr as SocketIp, ToSocketAddrs};
use std::os::unix::net::UnixListener;
use std::sync::mpsc;
use std::time::Duration;

use dimos_hardware::registry::SIM;
use dimos_rt::abstract_name::{self, Taken, fit};

/// Timeout for the lookup of a host name.
const LOOK_UP_LIMIT: Duration = Duration::from_secs(3);

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
    /// It is not of this computer, and the world of runs is closed.
    #[error("{adapter} at {address} is outside of DIMOS_WORLD, which has arms of this computer only")]
    OtherWorld {
        /// The adapter.
        adapter: String,
        /// The device's address.
        address: String,
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

impl DeviceLockError {
    /// Returns what the user can do about it.
    pub fn hint(&self) -> &'static str {
        match self {
            Self::OtherWorld { .. } => "unset DIMOS_WORLD",
            _ => "end the run or verb that uses it first: `dimos status` shows runs, `dimos down` ends one",
        }
    }
}

/// Locks the device at a complete address; the error names the process that holds it. Resolves host names. In a closed
/// world of runs (`is_closed`) it refuses a device that is not of this computer.
pub fn take(adapter: &str, address: &str, is_closed: bool) -> Result<DeviceLock, DeviceLockError> {
    if is_closed && !is_this_computer(address) {
        return Err(DeviceLockError::OtherWorld { adapter: adapter.to_owned(), address: address.to_owned() });
    }
    // Without the adapter: no two of them can use one place.
    let names = canonical_addresses(address).into_iter().map(|place| fit(format!("dimos/device/{place}")));
    let mut taken = Vec::new();
    for name in names {
        let (adapter, address) = (adapter.to_owned(), address.to_owned());
        taken.push(abstract_name::take(&name).map_err(|refused| match refused {
            Taken::By(peer) => {
                let pid = peer.map_or_else(|| "unknown".to_owned(), |peer| peer.pid.to_string());
                DeviceLockError::By { adapter, address, pid }
            }
            Taken::Io(error) => DeviceLockError::Io { adapter, address, error },
        })?);
    }
    Ok(DeviceLock(taken))
}

/// Returns whether two complete addresses lead to one place.
pub fn is_same_place(one: &str, other: &str) -> bool {
    !canonical_addresses(one).is_disjoint(&canonical_addresses(other))
}

/// Returns whether only a program on this computer can be at a complete address: `sim`, a loopback address, a
/// pseudo-terminal or a socket. Resolves host names, and links.
pub fn is_this_computer(address: &str) -> bool {
    let text = address.trim();
    let is_local = |place: &String| match place.parse::<SocketIp>() {
        Ok(at) => at.ip().is_loopback(),
        Err(_) => place.starts_with("/dev/pts/"),
    };
    // `0.0.0.0` leads to this computer, too.
    text == SIM
        || ["memory:", "unix:"].iter().any(|kind| text.starts_with(kind))
        || canonical_addresses(text).iter().all(is_local)
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
    // The kind is not part of the place: `slcan:/dev/ttyACM0`.
    if let Some((_, path)) = text.split_once(':').filter(|(_, path)| path.starts_with('/')) {
        return BTreeSet::from([device_file(path)]);
    }
    let text = text.to_ascii_lowercase();
    // A line at the tool of an arm: `xarm:HOST:PORT@RATE`. A host may have such a name.
    let of_tool = ["ur:", "xarm:"].iter().find_map(|kind| text.strip_prefix(kind)).filter(|rest| rest.contains(':'));
    let of_tool = of_tool.map(|rest| rest.split('@').next().unwrap_or(rest));
    let Some((host, port)) = host_and_port(of_tool.or(text.strip_prefix("tcp:")).unwrap_or(&text)) else {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn f29_a_device_is_taken_once_and_names_the_holder() {
        let port = std::process::id();
        let at = |host: &str| format!("{host}:{port}");
        let held = take("test", &at("LOCALHOST"), false).unwrap();
        for _ in 0..200 {
            let refused = take("test", &at("127.0.0.1"), false).unwrap_err().to_string();
            // The queue of connections fills up; then no process is named, and the call does not block.
            assert!(refused.contains(&format!("process {port}")) || refused.contains("unknown"), "{refused}");
        }
        assert!(take("test", &at("127.0.0.2"), false).is_ok());
        assert!(take("other", &at("127.0.0.1"), false).is_err(), "whatever the adapter");
        let elsewhere = take("test", "192.0.2.7:502", true).unwrap_err();
        assert!(matches!(elsewhere, DeviceLockError::OtherWorld { .. }), "{elsewhere}");
        drop(held);
        assert!(take("test", &at("127.0.0.1"), false).is_ok());
    }

    #[test]
    fn only_loopback_pseudo_terminals_and_sockets_are_this_computer() {
        for here in [
            "sim",
            "127.0.0.9:502",
            "[::1]:502",
            "0.0.0.0:9760",
            "localhost:1",
            "tcp:127.1.2.3:7",
            "unix:/x",
            "memory:1",
        ] {
            assert!(is_this_computer(here), "{here}");
        }
        let elsewhere = [
            "192.168.1.5:502",
            "can0",
            "/dev/ttyUSB0@1000000",
            "slcan:/dev/ttyACM0",
            "host.invalid:1",
            "",
            "[fe80::1]:1",
        ];
        for elsewhere in elsewhere {
            assert!(!is_this_computer(elsewhere), "{elsewhere}");
        }
        let (pty, folder) =
            (rustix::pty::openpt(rustix::pty::OpenptFlags::RDWR).unwrap(), tempfile::tempdir().unwrap());
        rustix::pty::grantpt(&pty).and_then(|()| rustix::pty::unlockpt(&pty)).unwrap();
        let name = rustix::pty::ptsname(&pty, Vec::new()).unwrap().into_string().unwrap();
        let link = folder.path().join("arm");
        std::os::unix::fs::symlink(&name, &link).unwrap();
        for pty in [format!("{name}@1000000"), format!("slcan:{name}"), link.display().to_string()] {
            assert!(is_this_computer(&pty), "{pty}");
        }
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
