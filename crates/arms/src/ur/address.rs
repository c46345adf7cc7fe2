//! Address of a controller: `HOST[:FIRST_PORT]`.

use dimos_hardware::transport::line::UR_TOOL_PORT;
use dimos_hardware::transport::tcp::Endpoint;

/// The first of a controller's ports: the dashboard's.
pub const FIRST_PORT: u16 = 29999;
/// How many consecutive ports follow from it, the first included. The second one is that of the Robot API, where the
/// first one is another: a controller has it at [`API_PORT`].
pub const PORTS: u16 = 6;
/// Port of the Robot API of a controller.
pub const API_PORT: u16 = 80;

/// A port of the controller. The number is its distance from the first one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u16)]
pub enum Service {
    /// Dashboard: text lines (29999).
    Dashboard = 0,
    /// Robot API of PolyScope X: HTTP (80).
    RobotApi = 1,
    /// Primary interface: state, messages, script (30001).
    Primary = 2,
    /// Secondary interface: state, script (30002).
    Secondary = 3,
    /// Real-time interface: script (30003). Its state stream is deprecated.
    RealTime = 4,
    /// RTDE: state and registers (30004).
    Rtde = 5,
    /// RS-485 of the tool (54321): not one of the consecutive ports.
    Tool = 6,
}

/// A controller's ports, which are consecutive as on every controller.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Address {
    first: Endpoint,
}

impl Address {
    /// Parses an address; the error is a sentence without full stop.
    pub fn parse(text: &str) -> Result<Self, String> {
        let first = Endpoint::parse(text, FIRST_PORT)?;
        let most = u16::MAX - PORTS + 1;
        if first.port > most {
            return Err(format!("{} is not the first of {PORTS} consecutive ports (1 to {most})", first.port));
        }
        Ok(Self { first })
    }

    /// Returns the host and the port of a service.
    pub fn port(&self, service: Service) -> Endpoint {
        if service == Service::Tool {
            return Endpoint { host: self.first.host.clone(), port: UR_TOOL_PORT };
        }
        if service == Service::RobotApi && self.first.port == FIRST_PORT {
            return Endpoint { host: self.first.host.clone(), port: API_PORT };
        }
        Endpoint { host: self.first.host.clone(), port: self.first.port.saturating_add(service as u16) }
    }
}

impl std::fmt::Display for Address {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.first.fmt(f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses() {
        let full = |text| Address::parse(text).map(|address| address.to_string());
        assert_eq!(full("192.168.1.5"), Ok("192.168.1.5:29999".into()));
        assert_eq!(full("127.0.0.1:41000"), Ok("127.0.0.1:41000".into()));
        for bad in ["", ":29999", "host:0", "host:65531", "host:1:2", "300.1.1.1"] {
            assert!(full(bad).is_err(), "{bad:?}");
        }
        let address = Address::parse("ur5e.local").unwrap();
        let ports = [Service::Primary, Service::Secondary, Service::RealTime, Service::Rtde, Service::RobotApi];
        assert_eq!(ports.map(|service| address.port(service).port), [30001, 30002, 30003, 30004, 80]);
        assert_eq!(Address::parse("127.0.0.1:41000").unwrap().port(Service::RobotApi).port, 41001);
    }
}
