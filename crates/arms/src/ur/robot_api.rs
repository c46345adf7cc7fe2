//! The Robot API of PolyScope X, in place of the dashboard: HTTP with JSON at port 80, from software 10.11. It takes
//! orders in remote control only. Paths and actions: the vendor's OpenAPI document, `/universal-robots/robot-api`.

use std::time::Duration;

use super::address::{Address, Service};
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::transport::Scan;
use dimos_hardware::transport::tcp::TcpLink;

/// Where the API begins.
pub const ROOT: &str = "/universal-robots/robot-api";
/// Paths of power, brakes and safety, and of the program.
pub const STATE: &str = "robotstate/v1/state";
/// See [`STATE`].
pub const PROGRAM: &str = "program/v1/state";
/// The orders of the dashboard, and what they are here: path and action.
pub const ORDERS: [(&str, &str, &str); 6] = [
    ("power on", STATE, "POWER_ON"),
    ("power off", STATE, "POWER_OFF"),
    ("brake release", STATE, "BRAKE_RELEASE"),
    ("unlock protective stop", STATE, "UNLOCK_PROTECTIVE_STOP"),
    ("restart safety", STATE, "RESTART_SAFETY"),
    ("stop", PROGRAM, "stop"),
];
/// Timeout of an answer.
const ANSWER: Duration = Duration::from_millis(1000);
/// Longest message, and most headers of one.
const LONGEST: usize = 64 * 1024;
const HEADERS: usize = 32;
/// What to do without it.
const AT_THE_PENDANT: &str =
    "\nhint: switch the arm on and release its brakes at the pendant, then enable it; the Robot API comes with 10.11";

/// An answer: its status, and its text.
type Answer = (u16, String);

/// Sends an order of the dashboard by the API.
pub fn order(address: &Address, request: &str, timeout: Duration) -> AdapterResult<()> {
    let Some((_, path, action)) = ORDERS.iter().find(|(name, ..)| *name == request) else {
        return Err(AdapterError::Rejected(format!("PolyScope X has no {request:?}")));
    };
    let place = address.port(Service::RobotApi);
    let unreachable = |error: AdapterError| {
        AdapterError::Rejected(format!("the Robot API of ur at {place} does not answer: {error}{AT_THE_PENDANT}"))
    };
    let body = format!("{{\"action\":\"{action}\"}}");
    let text = format!(
        "PUT {ROOT}/{path} HTTP/1.1\r\nHost: {}\r\nContent-Type: application/json\r\nContent-Length: {}\r\n\
         Connection: close\r\n\r\n{body}",
        place.host,
        body.len()
    );
    let mut link = TcpLink::connect("the Robot API of ur", &place, timeout).map_err(unreachable)?;
    let answer = link.send(text.as_bytes()).and_then(|()| link.receive(ANSWER, answer));
    let (status, text) = answer.map_err(unreachable)?;
    match status {
        200..=299 => Ok(()),
        403 => Err(AdapterError::Rejected(
            "the controller is in local control\nhint: select remote control at the pendant".into(),
        )),
        404 => Err(AdapterError::Rejected(format!("this PolyScope X has no {request:?}{AT_THE_PENDANT}"))),
        _ => Err(AdapterError::Rejected(format!("ur refuses {request:?}: {status} {text}"))),
    }
}

/// Scans for an answer.
pub(super) fn answer(bytes: &[u8]) -> Scan<Answer> {
    let mut headers = [httparse::EMPTY_HEADER; HEADERS];
    let mut head = httparse::Response::new(&mut headers);
    match head.parse(bytes) {
        Ok(status) => whole(bytes, status, head.headers)
            .map(|body| (head.code.unwrap_or_default(), String::from_utf8_lossy(body).into_owned())),
        Err(_) => Scan::Skip(bytes.len()),
    }
}

/// Scans for a request: its method, its path, its body.
pub(super) fn request(bytes: &[u8]) -> Scan<(String, String, Vec<u8>)> {
    let mut headers = [httparse::EMPTY_HEADER; HEADERS];
    let mut head = httparse::Request::new(&mut headers);
    let of = |part: Option<&str>| part.unwrap_or_default().to_owned();
    match head.parse(bytes) {
        Ok(status) => whole(bytes, status, head.headers).map(|body| (of(head.method), of(head.path), body.to_owned())),
        Err(_) => Scan::Skip(bytes.len()),
    }
}

/// Returns the body behind a head that was read.
fn whole<'a>(bytes: &'a [u8], head: httparse::Status<usize>, headers: &[httparse::Header<'_>]) -> Scan<&'a [u8]> {
    let httparse::Status::Complete(begun) = head else {
        return if bytes.len() <= LONGEST { Scan::More } else { Scan::Skip(bytes.len()) };
    };
    let length = headers.iter().find(|header| header.name.eq_ignore_ascii_case("content-length"));
    let length = length.and_then(|header| std::str::from_utf8(header.value).ok()?.trim().parse::<usize>().ok());
    let end = begun + length.unwrap_or(0).min(LONGEST);
    bytes.get(begun..end).map_or(Scan::More, |body| Scan::Take(end, body))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_answer_is_whole_when_its_body_is() {
        let text = b"HTTP/1.1 403 Forbidden\r\ncontent-length: 4\r\n\r\n{\"a\"";
        for end in 0..text.len() {
            assert!(matches!(answer(&text[..end]), Scan::More), "{end}");
        }
        assert!(
            matches!(answer(text), Scan::Take(length, (403, ref body)) if length == text.len() && body == "{\"a\"")
        );
        assert!(matches!(answer(b"Connected: Universal Robots Dashboard Server\n"), Scan::Skip(_)));
    }
}
