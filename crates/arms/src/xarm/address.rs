//! Address of a controller: `HOST[:CONTROL_PORT[:REPORT_PORT]]`.

use dimos_hardware::transport::tcp::Endpoint;

/// Port for commands.
pub const CONTROL_PORT: u16 = 502;
/// The first of the four report ports.
pub const REPORT_PORT: u16 = 30000;

/// A controller's ports. The four report ports are consecutive, as on every controller.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Address {
    /// Port for commands.
    pub control: Endpoint,
    /// The first report port.
    pub reports: u16,
}

impl Address {
    /// Parses an address; the error is a sentence without full stop.
    pub fn parse(text: &str) -> Result<Self, String> {
        let (control, reports) = match without_reports(text) {
            Some((control, reports)) => match reports.parse() {
                Ok(port @ 1..=65532) => (control, port),
                _ => return Err(format!("{reports:?} is not a report port (1 to 65532)")),
            },
            None => (text, REPORT_PORT),
        };
        Ok(Self { control: Endpoint::parse(control, CONTROL_PORT)?, reports })
    }

    /// Returns the second control port, one above the first. Newer boxes have it, for the tool's bus.
    pub fn second(&self) -> Endpoint {
        Endpoint { host: self.control.host.clone(), port: self.control.port.saturating_add(1) }
    }

    /// Returns the report port at this offset from the first.
    pub fn report(&self, offset: u16) -> Endpoint {
        Endpoint { host: self.control.host.clone(), port: self.reports.saturating_add(offset) }
    }
}

/// Splits off the third part, if there is one.
fn without_reports(text: &str) -> Option<(&str, &str)> {
    let ports = if text.starts_with('[') { text.find(']')? } else { 0 };
    let one_more = text.get(ports..)?.matches(':').count() == 2;
    one_more.then(|| text.rsplit_once(':')).flatten().filter(|_| text.parse::<std::net::Ipv6Addr>().is_err())
}

impl std::fmt::Display for Address {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}:{}", self.control, self.reports)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses() {
        let full = |text| Address::parse(text).map(|address| address.to_string());
        assert_eq!(full("192.168.1.185"), Ok("192.168.1.185:502:30000".into()));
        assert_eq!(full("arm.local:1502"), Ok("arm.local:1502:30000".into()));
        assert_eq!(full("127.0.0.1:1502:31000"), Ok("127.0.0.1:1502:31000".into()));
        assert_eq!(full("[::1]:1502:31000"), Ok("[::1]:1502:31000".into()));
        assert_eq!(full("::1"), Ok("[::1]:502:30000".into()));
        assert_eq!(full("[fe80::2]:502"), Ok("[fe80::2]:502:30000".into()));
        for bad in ["", ":502", "host:0", "host:1:0", "host:1:65533", "host:1:2:3", "host:1:", "host::2", "300.1.1.1"] {
            assert!(full(bad).is_err(), "{bad:?}");
        }
        let address = Address::parse("arm:1:2").unwrap();
        assert_eq!((address.report(3).port, address.second().port), (5, 2));
    }
}
