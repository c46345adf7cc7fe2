//! Who may use the page: those with the token, from a page of this server. Another page in the same browser has
//! neither: its `Origin` differs, and a name that it resolves to this computer is not an accepted `Host`.

use std::io;
use std::net::{IpAddr, SocketAddr};

use tokio_tungstenite::tungstenite::handshake::derive_accept_key;

use crate::http;
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
        are_equal(token, &self.token)
    }

    /// Returns whether this is the token that only allows to read.
    pub fn is_reading_token(&self, token: &str) -> bool {
        are_equal(token, &reading_token(&self.token))
    }

    /// Returns whether an `Authorization` header has the token.
    pub fn is_bearer(&self, header: Option<&str>) -> bool {
        header.and_then(|header| header.strip_prefix("Bearer ")).is_some_and(|token| self.is_token(token.trim()))
    }

    /// Returns whether a request was sent to this server by one of its pages, or by no page.
    pub fn is_own(&self, host: Option<&str>, origin: Option<&str>) -> bool {
        http::is_own(self.at, host, origin)
    }
}

fn are_equal(a: &str, b: &str) -> bool {
    let differ = |differ: u8, (a, b): (u8, u8)| differ | (a ^ b);
    a.len() == b.len() && a.bytes().zip(b.bytes()).fold(0, differ) == 0
}

/// Returns the token for viewers that only read. It is made of the page's by a hash (SHA-1, as for a WebSocket's key),
/// so that a viewer's URL, which other sites may learn, does not allow to command the arms.
pub fn reading_token(token: &str) -> String {
    derive_accept_key(token.as_bytes()).chars().filter(char::is_ascii_alphanumeric).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_run_has_another_token() {
        let (one, other) = [7000, 7001].map(|port| Access::new(([127, 0, 0, 1], port).into()).unwrap()).into();
        let token = |access: &Access| access.url().rsplit_once('#').unwrap().1.to_owned();
        assert_eq!((token(&one).len(), one.address()), (32, "http://127.0.0.1:7000/".to_owned()));
        let open = Access::new(([0, 0, 0, 0], 7001).into()).unwrap();
        assert_eq!(open.address(), "http://127.0.0.1:7001/");
        assert!(one.is_token(&token(&one)) && !one.is_token(&token(&other)) && !one.is_token(""));
        assert!(one.is_bearer(Some(&format!("Bearer {}", token(&one)))) && !one.is_bearer(None));
        assert!(!one.is_bearer(Some(&token(&one))));
        let reading = reading_token(&token(&one));
        assert!(one.is_reading_token(&reading) && !one.is_token(&reading) && !one.is_reading_token(&token(&one)));
        assert!(!other.is_reading_token(&reading) && !one.is_reading_token("") && reading.len() > 20);
    }
}
