//! Where a peer listens: a Unix socket or a loopback port. Nothing else, because the protocol has no authentication.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::PathBuf;

/// Longest path of a Unix socket [bytes].
const MAX_PATH: usize = 107;

/// The form of an address, for people.
pub const FORM: &str = "unix:/PATH | tcp:127.0.0.1:PORT";

/// Where a peer listens.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Address {
    /// A Unix socket.
    Unix(PathBuf),
    /// A port on a loopback address.
    Tcp(SocketAddr),
}

impl Address {
    /// Parses `unix:/PATH`, `tcp:HOST:PORT` or `HOST:PORT`, without using the network.
    pub fn parse(text: &str) -> Result<Self, String> {
        if let Some(path) = text.strip_prefix("unix:") {
            return match path.len() {
                _ if !path.starts_with('/') => Err(format!("{path:?} is not an absolute path")),
                length if length > MAX_PATH => Err(format!("the path has more than {MAX_PATH} bytes")),
                _ if path.ends_with('/') || path.contains('\0') => Err(format!("{path:?} is not the path of a socket")),
                _ => Ok(Self::Unix(path.into())),
            };
        }
        let place = text.strip_prefix("tcp:").unwrap_or(text);
        let (host, port) = place.rsplit_once(':').ok_or_else(|| format!("{text:?} has no port"))?;
        let port: u16 = match port.parse() {
            Ok(port) if port != 0 => port,
            _ => return Err(format!("{port:?} is not a port (1 to 65535)")),
        };
        let bare = host.strip_prefix('[').and_then(|h| h.strip_suffix(']')).unwrap_or(host);
        match bare.parse::<IpAddr>() {
            Ok(ip) if ip.is_loopback() => Ok(Self::Tcp(SocketAddr::new(ip, port))),
            Err(_) if host == "localhost" => Ok(Self::Tcp(SocketAddr::new(Ipv4Addr::LOCALHOST.into(), port))),
            Err(_) if host.is_empty() => Err("the host is missing".to_owned()),
            _ => Err(format!(
                "{host} may be another computer, and the protocol has no authentication: bring its port here with \
                 `ssh -L {port}:127.0.0.1:{port} {host}` and give tcp:127.0.0.1:{port}"
            )),
        }
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unix(path) => write!(f, "unix:{}", path.display()),
            Self::Tcp(address) => write!(f, "tcp:{address}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses() {
        let ok = |text: &str| Address::parse(text).map(|a| a.to_string());
        assert_eq!(ok("unix:/run/user/1000/arm.sock"), Ok("unix:/run/user/1000/arm.sock".into()));
        assert_eq!(ok("127.0.0.5:7450"), Ok("tcp:127.0.0.5:7450".into()));
        assert_eq!(ok("tcp:localhost:1"), Ok("tcp:127.0.0.1:1".into()));
        assert_eq!(ok("tcp:[::1]:7450"), Ok("tcp:[::1]:7450".into()));
        let long = format!("unix:/{}", "x".repeat(200));
        for bad in ["", "unix:", "unix:arm.sock", "unix:/run/", &long, "127.0.0.1", "127.0.0.1:0", "tcp::80", "::1"] {
            assert!(Address::parse(bad).is_err(), "{bad:?}");
        }
    }

    #[test]
    fn other_computers_are_refused_with_the_way_round() {
        for (host, address) in [("192.168.1.5", "192.168.1.5:80"), ("arm.local", "tcp:arm.local:80")] {
            let error = Address::parse(address).unwrap_err();
            assert!(error.contains("no authentication") && error.contains(&format!("ssh -L 80:127.0.0.1:80 {host}")));
        }
        assert!(Address::parse("0.0.0.0:80").is_err());
    }
}
