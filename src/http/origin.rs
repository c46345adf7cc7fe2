//! Who asks: a page in the same browser may belong to another site. Its `Origin` differs, and a name that it resolves
//! to this computer is not an accepted `Host`.

use std::net::{IpAddr, SocketAddr};

/// Returns whether a request was sent to the server at this address, by a page of that server or by no page.
pub fn is_own(at: SocketAddr, host: Option<&str>, origin: Option<&str>) -> bool {
    let Some(host) = host.filter(|host| is_host(at, host)) else { return false };
    origin.is_none_or(|origin| origin.strip_prefix("http://") == Some(host))
}

/// Returns whether a `Host` header names the server. Only an address can: other people control what a name resolves to,
/// `localhost` excepted.
fn is_host(at: SocketAddr, host: &str) -> bool {
    let (name, port) = host.rsplit_once(':').filter(|(_, port)| !port.ends_with(']')).unwrap_or((host, "80"));
    let bare = name.strip_prefix('[').and_then(|name| name.strip_suffix(']')).unwrap_or(name);
    let known = match bare.parse::<IpAddr>() {
        Ok(ip) => ip.is_loopback() || at.ip().is_unspecified() || ip == at.ip(),
        Err(_) => name.eq_ignore_ascii_case("localhost"),
    };
    known && port.parse() == Ok(at.port())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_this_server_and_its_pages_are_accepted() {
        let at: SocketAddr = "127.0.0.1:7000".parse().unwrap();
        for host in ["127.0.0.1:7000", "localhost:7000", "LOCALHOST:7000", "[::1]:7000", "127.0.0.2:7000"] {
            assert!(is_own(at, Some(host), None) && is_own(at, Some(host), Some(&format!("http://{host}"))));
            assert!(!is_own(at, Some(host), Some("http://evil.test:7000")) && !is_own(at, Some(host), Some("null")));
        }
        for host in ["evil.test:7000", "127.0.0.1.evil.test:7000", "127.0.0.1", "127.0.0.1:7001", "[::1]", "", ":7000"]
        {
            assert!(!is_own(at, Some(host), None), "{host}");
        }
        assert!(!is_own(at, None, None) && !is_own(at, Some("10.0.0.5:7000"), None));
        assert!(!is_own(at, Some("127.0.0.1:7000"), Some("https://127.0.0.1:7000")));

        let open = "0.0.0.0:7001".parse().unwrap();
        assert!(is_own(open, Some("10.0.0.5:7001"), None) && !is_own(open, Some("robot.test:7001"), None));
        let one = "10.0.0.5:80".parse().unwrap();
        assert!(is_own(one, Some("10.0.0.5"), None) && !is_own(one, Some("10.0.0.6"), None));
    }
}
