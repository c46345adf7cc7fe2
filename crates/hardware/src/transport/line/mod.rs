//! Lines of bytes by address: a serial device, a TCP socket that carries the bytes of one, or the RS-485 line at the
//! tool flange of an xArm or a UR.

use std::time::Duration;

use super::Scan;
use super::request_reply::ByteLink;
use super::serial::{SerialAddress, SerialLink};
use super::tcp::{Endpoint, TcpLink};
use crate::adapter::AdapterResult;

pub mod xarm_tool;

/// Port of a UR's RS485 URCap, or of tool forwarding of PolyScope X.
pub const UR_TOOL_PORT: u16 = 54321;

/// Address of a line: `/dev/ttyX[@BAUD]`, `tcp:HOST:PORT`, `ur:HOST[:PORT]` or `xarm:HOST[:PORT][@BAUD]`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LineAddress {
    /// A serial device of this computer.
    Serial(SerialAddress),
    /// A socket that carries the bytes of a line, as serial device servers have it.
    Tcp(Endpoint),
    /// The tool of a UR: a socket alike. Its rate is an option of the arm.
    UrTool(Endpoint),
    /// The tool of an xArm, and the rate that it must have [bit/s].
    XarmTool(Endpoint, u32),
}

/// Forms of an address, for the row of an adapter.
pub const FORM: &str = "/dev/ttyX[@BAUD], tcp:HOST:PORT, ur:HOST[:PORT] or xarm:HOST[:PORT][@BAUD]";

impl LineAddress {
    /// Parses an address; the error is a sentence without full stop. Opens nothing.
    pub fn parse(text: &str, default_baud: u32) -> Result<Self, String> {
        let Some((kind, rest)) = text.split_once(':').filter(|_| !text.starts_with('/')) else {
            return SerialAddress::parse(text, default_baud).map(Self::Serial);
        };
        match kind {
            "tcp" => match Endpoint::parse(rest, 0)? {
                Endpoint { port: 0, .. } => Err(format!("{text:?} lacks the port")),
                endpoint => Ok(Self::Tcp(endpoint)),
            },
            "ur" if rest.contains('@') => Err("the rate of a UR's tool is the arm's option `tool_line`".to_owned()),
            "ur" => Endpoint::parse(rest, UR_TOOL_PORT).map(Self::UrTool),
            "xarm" => {
                let (host, rate) = rest.split_once('@').map_or((rest, None), |(host, rate)| (host, Some(rate)));
                let baud = rate.map_or(Ok(default_baud), str::parse);
                let baud = baud.map_err(|_| format!("{:?} is not a rate [bit/s]", rate.unwrap_or_default()))?;
                Ok(Self::XarmTool(Endpoint::parse(host, xarm_tool::PORT)?, baud))
            }
            _ => Err(format!("{text:?} is not a line: {FORM}")),
        }
    }
}

impl std::fmt::Display for LineAddress {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Serial(address) => address.fmt(f),
            Self::Tcp(endpoint) => write!(f, "tcp:{endpoint}"),
            Self::UrTool(endpoint) => write!(f, "ur:{endpoint}"),
            Self::XarmTool(endpoint, baud) => write!(f, "xarm:{endpoint}@{baud}"),
        }
    }
}

/// An open line.
#[derive(Debug)]
pub enum Line {
    /// A serial device.
    Serial(SerialLink),
    /// A socket.
    Tcp(TcpLink),
    /// The tool of an xArm.
    XarmTool(xarm_tool::ToolLine),
}

impl Line {
    /// Opens the line at `address`. `device` names the device in messages; `timeout` limits the connection, and each
    /// write to a serial device. Does not show whether the device is there.
    pub fn connect(device: &str, address: &LineAddress, timeout: Duration) -> AdapterResult<Self> {
        Ok(match address {
            LineAddress::Serial(SerialAddress { path, baud }) => {
                Self::Serial(SerialLink::connect(device, path, *baud, timeout)?)
            }
            LineAddress::Tcp(endpoint) | LineAddress::UrTool(endpoint) => {
                Self::Tcp(TcpLink::connect(device, endpoint, timeout)?)
            }
            LineAddress::XarmTool(endpoint, baud) => {
                Self::XarmTool(xarm_tool::ToolLine::connect(device, endpoint, *baud, timeout)?)
            }
        })
    }
}

impl ByteLink for Line {
    fn send(&mut self, bytes: &[u8]) -> AdapterResult<()> {
        match self {
            Self::Serial(line) => line.send(bytes),
            Self::Tcp(line) => line.send(bytes),
            Self::XarmTool(line) => line.send(bytes),
        }
    }

    fn receive<T>(&mut self, timeout: Duration, scan: impl FnMut(&[u8]) -> Scan<T>) -> AdapterResult<T> {
        match self {
            Self::Serial(line) => line.receive(timeout, scan),
            Self::Tcp(line) => line.receive(timeout, scan),
            Self::XarmTool(line) => line.receive(timeout, scan),
        }
    }

    fn drain(&mut self) -> AdapterResult<()> {
        match self {
            Self::Serial(line) => line.drain(),
            Self::Tcp(line) => line.drain(),
            Self::XarmTool(line) => line.drain(),
        }
    }

    fn abort(self) {
        match self {
            Self::Serial(line) => line.abort(),
            Self::Tcp(line) => line.abort(),
            Self::XarmTool(line) => line.abort(),
        }
    }
}
