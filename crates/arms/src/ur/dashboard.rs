//! The dashboard: power, brakes, safety, programs. A connection for each occasion: an order is rare, and an idle
//! connection would hide that the controller has restarted.

use std::time::Duration;

use super::address::{Address, Service};
use super::robot_api;
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::transport::Scan;
use dimos_hardware::transport::tcp::TcpLink;

/// Timeouts of the greeting and of an answer.
const GREETING: Duration = Duration::from_millis(1000);
const ANSWER: Duration = Duration::from_millis(1000);
/// Longest line.
const LONGEST: usize = 1024;

/// A connection to the dashboard.
pub struct Dashboard {
    link: TcpLink,
}

/// What takes orders besides motion.
pub enum Panel {
    /// The dashboard.
    Dashboard(Dashboard),
    /// The Robot API of PolyScope X, which has no dashboard.
    RobotApi(Address, Duration),
}

impl Panel {
    /// Sends an order; `Rejected` unless it is taken, as the answer of the dashboard begins then.
    pub fn order(&mut self, request: &str, expected: &str) -> AdapterResult<()> {
        match self {
            Self::Dashboard(dashboard) => dashboard.order(request, expected),
            Self::RobotApi(address, timeout) => robot_api::order(address, request, *timeout),
        }
    }

    /// Closes the message of a safety stop, where it must be closed before the arm is switched on.
    pub fn close_safety_popup(&mut self) -> AdapterResult<()> {
        match self {
            Self::Dashboard(dashboard) => dashboard.ask("close safety popup").map(|_| ()),
            Self::RobotApi(..) => Ok(()),
        }
    }

    /// Returns whether the controller takes orders and programs: not in local control. Series before e have no such
    /// switch; the Robot API says so with the first order.
    pub fn is_in_remote_control(&mut self, cb3: bool) -> AdapterResult<bool> {
        match self {
            Self::Dashboard(dashboard) => Ok(cb3 || dashboard.ask("is in remote control")? != "false"),
            Self::RobotApi(..) => Ok(true),
        }
    }
}

/// Scans for a line, without its end.
fn line(bytes: &[u8]) -> Scan<String> {
    match bytes.iter().position(|byte| *byte == b'\n') {
        Some(end) => Scan::Take(end + 1, String::from_utf8_lossy(bytes.get(..end).unwrap_or_default()).trim().into()),
        None if bytes.len() > LONGEST => Scan::Skip(bytes.len()),
        None => Scan::More,
    }
}

impl Dashboard {
    /// Connects and waits for the greeting.
    pub fn connect(address: &Address, timeout: Duration) -> AdapterResult<Self> {
        let link = TcpLink::connect("the dashboard of ur", &address.port(Service::Dashboard), timeout);
        let mut link = link.map_err(unreachable)?;
        let greeting = link.receive(GREETING.min(timeout), line).map_err(unreachable)?;
        if !greeting.contains("Dashboard Server") {
            let what = format!("{} is not a dashboard: {greeting:?}", link.peer());
            return Err(AdapterError::Protocol(what));
        }
        Ok(Self { link })
    }

    /// Sends a request and returns the answer. After an error this connection is of no more use: a late answer would
    /// be taken for the next one.
    pub fn ask(&mut self, request: &str) -> AdapterResult<String> {
        let sent = self.link.send(format!("{request}\n").as_bytes());
        sent.and_then(|()| self.link.receive(ANSWER, line)).map_err(unreachable)
    }

    /// Sends an order; `Rejected` unless the answer begins as expected.
    pub fn order(&mut self, request: &str, expected: &str) -> AdapterResult<()> {
        let answer = self.ask(request)?;
        if answer.to_ascii_lowercase().starts_with(&expected.to_ascii_lowercase()) {
            return Ok(());
        }
        let hint = if answer.contains("not allowed") { "\nhint: select remote control at the pendant" } else { "" };
        Err(AdapterError::Rejected(format!("ur refuses {request:?}: {answer}{hint}")))
    }
}

/// The state and the orders have connections of their own, which are not broken by this one.
fn unreachable(error: AdapterError) -> AdapterError {
    match error {
        AdapterError::Io(text) => AdapterError::Rejected(text),
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines() {
        assert_eq!(line(b"Robotmode: RUNNING\nmore"), Scan::Take(19, "Robotmode: RUNNING".into()));
        assert_eq!(line(b"Robotm"), Scan::More);
        assert_eq!(line(&[b'x'; 2000]), Scan::Skip(2000));
    }
}
