//! The HTTP of the live view and of the metrics: one `GET` per connection. `httparse`, which hyper also uses, reads the
//! head; a request has no body, and the end of the connection is the end of the reply.

mod origin;

use std::borrow::Cow;
use std::io;
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::timeout;

pub use origin::is_own;

/// Maximum length of a request's head [bytes]: cookies of all servers of this computer are in it.
const MAX_HEAD: usize = 32 << 10;
/// Maximum number of headers.
const MAX_HEADERS: usize = 64;
/// Time limit for the head.
const HEAD_TIMEOUT: Duration = Duration::from_secs(5);
/// Time limit for a reply: the largest mesh through a slow tunnel.
const REPLY_TIMEOUT: Duration = Duration::from_secs(60);

/// Maximum number of bytes behind a request that are discarded.
const MAX_UNREAD: u64 = 1 << 20;
/// Time limit for the client to close the connection.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(1);

/// Headers of every reply. No other site may embed the page or read from it.
const COMMON: &str = "X-Content-Type-Options: nosniff\r\nReferrer-Policy: no-referrer\r\n\
Cross-Origin-Resource-Policy: same-origin\r\nConnection: close\r\n";

/// The head of a request.
#[derive(Debug, Default)]
pub struct Request {
    /// `GET`.
    pub method: String,
    /// Path, without a query.
    pub path: String,
    /// Query, without `?`.
    pub query: String,
    /// Names in lower case, and values.
    headers: Vec<(String, String)>,
    /// What was received behind the head.
    pub rest: Vec<u8>,
}

impl Request {
    /// Returns a header; the first if there are several.
    pub fn header(&self, name: &str) -> Option<&str> {
        self.headers.iter().find(|(own, _)| own == name).map(|(_, value)| value.as_str())
    }

    /// Returns whether a header has this word in its list.
    pub fn has_word(&self, name: &str, word: &str) -> bool {
        self.header(name).is_some_and(|list| list.split(',').any(|own| own.trim().eq_ignore_ascii_case(word)))
    }
}

/// A reply.
#[derive(Debug)]
pub struct Reply {
    /// Status code.
    pub status: u16,
    /// Content type.
    pub kind: &'static str,
    /// Further headers, each with its line end.
    pub headers: &'static str,
    /// Content.
    pub body: Cow<'static, [u8]>,
    /// Whether browsers may keep it for good: its address has its hash.
    pub keep: bool,
}

impl Reply {
    /// Creates a reply with a short text.
    pub fn text(status: u16, text: impl Into<String>) -> Self {
        let body = Cow::Owned((text.into() + "\n").into_bytes());
        Self { status, kind: "text/plain; charset=utf-8", headers: "", body, keep: false }
    }
}

/// Reads the head of a request. `None`: the client closed the connection or was too slow. An error is the reply to a
/// head that cannot be read.
pub async fn read(stream: &mut TcpStream) -> Result<Option<Request>, Reply> {
    let mut received = Vec::new();
    let reading = async {
        loop {
            if stream.read_buf(&mut received).await.ok()? == 0 {
                return None;
            }
            match parse(&received) {
                Ok(Some((mut request, length))) => {
                    request.rest = received.split_off(length);
                    return Some(Ok(request));
                }
                Ok(None) if received.len() < MAX_HEAD => {}
                Ok(None) => return Some(Err(Reply::text(431, "the head of the request is too large"))),
                Err(error) => return Some(Err(Reply::text(400, error.to_string()))),
            }
        }
    };
    timeout(HEAD_TIMEOUT, reading).await.ok().flatten().transpose()
}

/// Returns a complete head with its length; `None` if it is not complete.
fn parse(bytes: &[u8]) -> Result<Option<(Request, usize)>, httparse::Error> {
    let mut headers = [httparse::EMPTY_HEADER; MAX_HEADERS];
    let mut head = httparse::Request::new(&mut headers);
    let httparse::Status::Complete(length) = head.parse(bytes)? else { return Ok(None) };
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    let target = head.path.unwrap_or_default();
    let (path, query) = target.split_once('?').unwrap_or((target, ""));
    let request = Request {
        method: head.method.unwrap_or_default().to_owned(),
        path: decoded(path),
        query: decoded(query),
        headers: head.headers.iter().map(|h| (h.name.to_ascii_lowercase(), text(h.value))).collect(),
        rest: Vec::new(),
    };
    Ok(Some((request, length)))
}

/// Decodes `%41` to `A`.
fn decoded(path: &str) -> String {
    let (mut bytes, mut rest) = (Vec::new(), path.as_bytes());
    while let [first, after @ ..] = rest {
        let code = after.get(..2).filter(|_| *first == b'%').and_then(|code| std::str::from_utf8(code).ok());
        let byte = code.and_then(|code| u8::from_str_radix(code, 16).ok());
        bytes.push(byte.unwrap_or(*first));
        rest = if byte.is_some() { &after[2..] } else { after };
    }
    String::from_utf8_lossy(&bytes).into_owned()
}

/// Sends a reply and closes the connection.
pub async fn send(stream: &mut TcpStream, reply: Reply) -> io::Result<()> {
    let Reply { status, kind, headers, body, keep } = reply;
    let cache = if keep { "private, max-age=31536000, immutable" } else { "no-store" };
    let head = format!(
        "HTTP/1.1 {status} {}\r\nContent-Type: {kind}\r\nContent-Length: {}\r\nCache-Control: {cache}\r\n\
        {COMMON}{headers}\r\n",
        reason(status),
        body.len()
    );
    let sending = async {
        stream.write_all(head.as_bytes()).await?;
        stream.write_all(&body).await?;
        stream.shutdown().await
    };
    timeout(REPLY_TIMEOUT, sending).await.unwrap_or_else(|_| Err(io::ErrorKind::TimedOut.into()))?;
    // Closing with unread bytes would discard the reply.
    let mut unread = stream.take(MAX_UNREAD);
    let _ = timeout(CLOSE_TIMEOUT, tokio::io::copy(&mut unread, &mut tokio::io::sink())).await;
    Ok(())
}

fn reason(status: u16) -> &'static str {
    match status {
        200 => "OK",
        400 => "Bad Request",
        401 => "Unauthorized",
        403 => "Forbidden",
        404 => "Not Found",
        405 => "Method Not Allowed",
        426 => "Upgrade Required",
        503 => "Service Unavailable",
        431 => "Request Header Fields Too Large",
        _ => "Internal Server Error",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_head_is_read_when_it_is_complete() {
        let text =
            b"GET /mesh/3?x=%221 HTTP/1.1\r\nHOST: localhost:7000\r\nConnection: keep-alive, Upgrade\r\n\r\nrest";
        for length in 0..text.len() - 4 {
            assert!(parse(&text[..length]).unwrap().is_none(), "{length}");
        }
        let (request, length) = parse(text).unwrap().unwrap();
        assert_eq!((request.method.as_str(), request.path.as_str(), &text[length..]), ("GET", "/mesh/3", &b"rest"[..]));
        assert_eq!((request.header("host"), request.query.as_str()), (Some("localhost:7000"), "x=\"1"));
        assert!(request.has_word("connection", "upgrade") && !request.has_word("connection", "close"));
        for (path, text) in [("/a%20b", "/a b"), ("/%C3%A4%2f", "/ä/"), ("/100%", "/100%"), ("/%g0%4", "/%g0%4")] {
            assert_eq!(decoded(path), text);
        }
        assert!(parse(b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03").is_err(), "TLS");
        assert!(parse(format!("GET / HTTP/1.1\r\n{}\r\n", "a: b\r\n".repeat(MAX_HEADERS + 1)).as_bytes()).is_err());
    }
}
