//! What the bytes travel on: a serial line of this computer, 8 data bits, no parity, 1 stop bit, or the line at the
//! tool of an arm.

use std::time::Duration;

use dimos_hardware::adapter::AdapterResult;
use dimos_hardware::registry::EmulatorAddress;
use dimos_hardware::sim::serial_server::SerialServer;
use dimos_hardware::sim::stream::Controller;
use dimos_hardware::transport::line::{self, Line, LineAddress};

/// Rate of the line, where an address names none [bit/s].
const BAUD: u32 = 1_000_000; // YOUR ARM
/// Longest wait until the line is connected, or takes a command.
const SEND_TIMEOUT: Duration = Duration::from_millis(500);

/// Where a controller is.
pub type Address = LineAddress;
/// The line to it.
pub type Link = Line;

/// What it is called in tables.
pub const TRANSPORT: &str = "serial";
/// How an address is written.
pub const FORM: &str = line::FORM;

/// Reads an address; what is wrong with it, in a sentence without full stop.
pub fn address(text: &str) -> Result<Address, String> {
    LineAddress::parse(text, BAUD)
}

/// Opens the line to a controller. That it is there shows only when it answers.
pub fn connect(address: &Address) -> AdapterResult<Link> {
    Line::connect("acme", address, SEND_TIMEOUT)
}

/// Puts an emulated controller on the wire: a pseudo-terminal.
pub fn serve<C: Controller>(controller: C, place: &EmulatorAddress) -> AdapterResult<SerialServer<C>> {
    SerialServer::start("acme", controller, place)
}
