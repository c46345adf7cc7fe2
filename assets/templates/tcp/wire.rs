//! What the bytes travel on: a TCP connection to the controller's port.

use std::time::Duration;

use dimos_hardware::adapter::AdapterResult;
use dimos_hardware::registry::EmulatorAddress;
use dimos_hardware::sim::stream::Controller;
use dimos_hardware::sim::tcp_server::TcpServer;
use dimos_hardware::transport::tcp::{Endpoint, TcpLink};

/// The controller's TCP port, where an address names none.
const PORT: u16 = 7700; // YOUR ARM
/// Longest wait for the connection.
const CONNECT_TIMEOUT: Duration = Duration::from_millis(1500);

/// Where a controller is.
pub type Address = Endpoint;
/// The connection to it.
pub type Link = TcpLink;

/// What it is called in tables.
pub const TRANSPORT: &str = "tcp";
/// How an address is written.
pub const FORM: &str = "HOST[:PORT]";

/// Reads an address; what is wrong with it, in a sentence without full stop.
pub fn address(text: &str) -> Result<Address, String> {
    Endpoint::parse(text, PORT)
}

/// Connects to a controller.
pub fn connect(address: &Address) -> AdapterResult<Link> {
    TcpLink::connect("acme", address, CONNECT_TIMEOUT)
}

/// Puts an emulated controller on the wire.
pub fn serve<C: Controller>(controller: C, place: &EmulatorAddress) -> AdapterResult<TcpServer<C>> {
    TcpServer::start("acme", controller, place.tcp(PORT)?)
}
