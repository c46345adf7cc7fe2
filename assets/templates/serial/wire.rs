//! What the bytes travel on: a serial line, 8 data bits, no parity, 1 stop bit.

use std::time::Duration;

use dimos::hardware::adapter::AdapterResult;
use dimos::hardware::registry::EmulatorAddress;
use dimos::hardware::sim::serial_server::SerialServer;
use dimos::hardware::sim::stream::Controller;
use dimos::hardware::transport::serial::{SerialAddress, SerialLink};

/// Rate of the line, where an address names none [bit/s].
const BAUD: u32 = 1_000_000; // YOUR ARM
/// Longest wait until the line takes a command.
const SEND_TIMEOUT: Duration = Duration::from_millis(100);

/// Where a controller is.
pub type Address = SerialAddress;
/// The line to it.
pub type Link = SerialLink;

/// What it is called in tables.
pub const TRANSPORT: &str = "serial";
/// How an address is written.
pub const FORM: &str = "/dev/ttyX[@BAUD]";

/// Reads an address; what is wrong with it, in a sentence without full stop.
pub fn address(text: &str) -> Result<Address, String> {
    SerialAddress::parse(text, BAUD)
}

/// Opens the line to a controller. That it is there shows only when it answers.
pub fn connect(address: &Address) -> AdapterResult<Link> {
    SerialLink::connect("acme", &address.path, address.baud, SEND_TIMEOUT)
}

/// Puts an emulated controller on the wire: a pseudo-terminal.
pub fn serve<C: Controller>(controller: C, place: &EmulatorAddress) -> AdapterResult<SerialServer<C>> {
    SerialServer::start("acme", controller, place)
}
