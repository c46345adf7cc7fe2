//! Notifies the service manager (systemd), if there is one, of the start and end of the run, and feeds its watchdog
//! while the tick is alive.
//!
//! It receives datagrams on the socket that `NOTIFY_SOCKET` names: `READY=1`, `WATCHDOG=1` and the like.

use std::ffi::OsString;
use std::io;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::time::{Duration, Instant};

/// Connection to the service manager. Messages that cannot be delivered are dropped: no call blocks or fails.
#[derive(Debug)]
pub struct ServiceManager {
    socket: UnixDatagram,
    address: SocketAddr,
    watchdog: Option<Duration>,
}

impl ServiceManager {
    /// Returns the connection to the service manager that started this process, from `NOTIFY_SOCKET`; `None`
    /// if there is none.
    pub fn from_env() -> Option<Self> {
        let variable = |name| std::env::var(name).ok().and_then(|value| value.parse::<u64>().ok());
        let ours = variable("WATCHDOG_PID").is_none_or(|pid| pid == u64::from(std::process::id()));
        let watchdog = variable("WATCHDOG_USEC").filter(|usec| ours && *usec > 0).map(Duration::from_micros);
        Self::at(std::env::var_os("NOTIFY_SOCKET")?, watchdog).ok()
    }

    /// Creates a connection to a service manager at an address (a path, or `@` and an abstract name), with this
    /// watchdog interval.
    pub fn at(address: OsString, watchdog: Option<Duration>) -> io::Result<Self> {
        let address = match address.as_bytes().strip_prefix(b"@") {
            Some(name) => SocketAddr::from_abstract_name(name)?,
            None => SocketAddr::from_pathname(&address)?,
        };
        let socket = UnixDatagram::unbound()?;
        socket.set_nonblocking(true)?;
        Ok(Self { socket, address, watchdog })
    }

    /// Reports that the run is up, with a status line.
    pub fn ready(&self, status: &str) {
        self.notify(&format!("READY=1\nSTATUS={}", one_line(status)));
    }

    /// Reports a status line.
    pub fn status(&self, status: &str) {
        self.notify(&format!("STATUS={}", one_line(status)));
    }

    /// Reports that the run shuts down.
    pub fn stopping(&self) {
        self.notify("STOPPING=1\nSTATUS=decelerating, then releasing the arms");
    }

    /// Returns the watchdog's work at each check that finds the tick alive: a ping, twice per requested interval.
    pub fn watchdog_ping(&self) -> io::Result<impl FnMut() + Send + 'static> {
        let pinger = Self { socket: self.socket.try_clone()?, address: self.address.clone(), watchdog: self.watchdog };
        let mut last: Option<Instant> = None;
        Ok(move || {
            let due = pinger.watchdog.filter(|every| last.is_none_or(|last| last.elapsed() >= *every / 2));
            if due.is_some() {
                last = Some(Instant::now());
                pinger.notify("WATCHDOG=1");
            }
        })
    }

    fn notify(&self, message: &str) {
        let _ = self.socket.send_to_addr(message.as_bytes(), &self.address);
    }
}

fn one_line(text: &str) -> String {
    text.replace('\n', "; ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn received(socket: &UnixDatagram) -> Vec<String> {
        socket.set_nonblocking(true).unwrap();
        let mut buffer = [0; 256];
        let next = || socket.recv(&mut buffer).ok().map(|n| String::from_utf8_lossy(&buffer[..n]).into_owned());
        std::iter::from_fn(next).collect()
    }

    #[test]
    fn messages_reach_a_path_and_an_abstract_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notify");
        let name = format!("@dimos-test-{}", std::process::id());
        let of_name = SocketAddr::from_abstract_name(&name[1..]).unwrap();
        let sockets = [UnixDatagram::bind(&path).unwrap(), UnixDatagram::bind_addr(&of_name).unwrap()];
        for (socket, address) in sockets.iter().zip([path.into_os_string(), name.into()]) {
            let manager = ServiceManager::at(address, None).unwrap();
            manager.ready("one\ntwo");
            manager.stopping();
            let messages = received(socket);
            assert_eq!(messages[0], "READY=1\nSTATUS=one; two");
            assert!(messages[1].starts_with("STOPPING=1\n") && messages.len() == 2);
        }
    }

    #[test]
    fn pings_are_sent_only_with_a_watchdog_interval() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notify");
        let socket = UnixDatagram::bind(&path).unwrap();
        for (watchdog, expected) in [(None, 0), (Some(Duration::from_secs(3600)), 1), (Some(Duration::ZERO), 3)] {
            let manager = ServiceManager::at(path.clone().into_os_string(), watchdog).unwrap();
            let mut alive = manager.watchdog_ping().unwrap();
            (0..3).for_each(|_| alive());
            assert_eq!(received(&socket).len(), expected, "{watchdog:?}");
        }
    }

    #[test]
    fn a_missing_notify_socket_is_ignored() {
        ServiceManager::at("/nonexistent/notify".into(), None).unwrap().ready("x");
        assert!(ServiceManager::at("/".repeat(200).into(), None).is_err());
    }
}
