//! Who may use the page: those with the token, from a page of this server. Another page in the same browser has
//! neither: its `Origin` differs, and a name that it resolves to this computer is not an accepted `Host`.

use std::io;
use std::net::{IpAddr, SocketAddr};

use dimos_core::random;

/// What gives access to the page of one run.
#[derive(Debug)]
pub struct Access {
    at: SocketAddr,
    token: String,
}

impl Access {
    /// Makes a new token for the page at this address.
    pub fn new(at: SocketAddr) -> io::Result<Self> {
        Ok(Self { at, token: format!("{:032x}", u128::from_le_bytes(random::bytes()?)) })
    }

    /// Returns the address of the page. A browser on this computer opens it, whatever address the server listens at.
    pub fn address(&self) -> String {
        let mut at = self.at;
        if at.ip().is_unspecified() {
            at.set_ip(if at.is_ipv4() { [127, 0, 0, 1].into() } else { IpAddr::from([0, 0, 0, 0, 0, 0, 0, 1]) });
        }
        format!("http://{at}/")
    }

    /// Returns the address with the token.
    pub fn url(&self) -> String {
        format!("{}#{}", self.address(), self.token)
    }

    /// Returns whether this is the token. Takes the same time for every token of its length.
    pub fn is_token(&self, token: &str) -> bool {
        let differ = |differ: u8, (a, b): (u8, u8)| differ | (a ^ b);
        token.len() == self.token.len() && token.bytes().zip(self.token.bytes()).fold(0, differ) == 0
    }

    /// Returns whether an `Authorization` header has the token.
    pub fn is_bearer(&self, header: Option<&str>) -> bool {
        header.and_then(|header| header.strip_prefix("Bearer ")).is_some_and(|token| self.is_token(token.trim()))
    }

    /// Returns whether a request was sent to this server by one of its pages, or by no page.
    pub fn is_own(&self, host: Option<&str>, origin: Option<&str>) -> bool {
        let Some(host) = host.filter(|host| self.is_host(host)) else { return false };
        origin.is_none_or(|origin| origin.strip_prefix("http://") == Some(host))
    }

    /// Returns whether a `Host` header names this server. Only an address can: other people control what a name
    /// resolves to, `localhost` excepted.
    fn is_host(&self, host: &str) -> bool {
        let (name, port) = host.rsplit_once(':').filter(|(_, port)| !port.ends_with(']')).unwrap_or((host, "80"));
        let bare = name.strip_prefix('[').and_then(|name| name.strip_suffix(']')).unwrap_or(name);
        let known = match bare.parse::<IpAddr>() {
            Ok(ip) => ip.is_loopback() || self.at.ip().is_unspecified() || ip == self.at.ip(),
            Err(_) => name.eq_ignore_ascii_case("localhost"),
        };
        known && port.parse() == Ok(self.at.port())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_this_server_and_its_pages_are_accepted() {
        let access = Access::new("127.0.0.1:7000".parse().unwrap()).unwrap();
        for host in ["127.0.0.1:7000", "localhost:7000", "LOCALHOST:7000", "[::1]:7000", "127.0.0.2:7000"] {
            assert!(access.is_own(Some(host), None) && access.is_own(Some(host), Some(&format!("http://{host}"))));
            assert!(
                !access.is_own(Some(host), Some("http://evil.test:7000")) && !access.is_own(Some(host), Some("null"))
            );
        }
        for host in ["evil.test:7000", "127.0.0.1.evil.test:7000", "127.0.0.1", "127.0.0.1:7001", "[::1]", "", ":7000"]
        {
            assert!(!access.is_own(Some(host), None), "{host}");
        }
        assert!(!access.is_own(None, None) && !access.is_own(Some("10.0.0.5:7000"), None));
        assert!(!access.is_own(Some("127.0.0.1:7000"), Some("https://127.0.0.1:7000")));

        let open = Access::new("0.0.0.0:7001".parse().unwrap()).unwrap();
        assert!(open.is_own(Some("10.0.0.5:7001"), None) && !open.is_own(Some("robot.test:7001"), None));
        assert_eq!(open.address(), "http://127.0.0.1:7001/");
        let one = Access::new("10.0.0.5:80".parse().unwrap()).unwrap();
        assert!(one.is_own(Some("10.0.0.5"), None) && !one.is_own(Some("10.0.0.6"), None));
    }

    #[test]
    fn every_run_has_another_token() {
        let (one, other) = [7000, 7001].map(|port| Access::new(([127, 0, 0, 1], port).into()).unwrap()).into();
        let token = |access: &Access| access.url().rsplit_once('#').unwrap().1.to_owned();
        assert_eq!((token(&one).len(), one.address()), (32, "http://127.0.0.1:7000/".to_owned()));
        assert!(one.is_token(&token(&one)) && !one.is_token(&token(&other)) && !one.is_token(""));
        assert!(one.is_bearer(Some(&format!("Bearer {}", token(&one)))) && !one.is_bearer(None));
        assert!(!one.is_bearer(Some(&token(&one))));
    }
}
