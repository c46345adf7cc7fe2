//! Outputs are set over a second RTDE connection, which is opened for the first one: the outputs are claimed only where
//! they are used, and other clients can set them everywhere else.

use std::time::Duration;

use super::address::Address;
use super::protocol::inputs;
use super::protocol::rtde::{encode, kind, recipe};
use super::rtde::{claim, open, request};
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::transport::tcp::TcpLink;

/// Timeout of the whole connection.
const CONNECT: Duration = Duration::from_millis(700);
/// The value that the controller sends on this connection, and how often [Hz]: it starts none without one.
const VALUE: (&str, f64) = ("timestamp", 1.0);

/// A connection that has the outputs.
pub struct Outputs {
    link: TcpLink,
    /// Numbers of the input recipes; `None`: another client has them.
    digital: Option<u8>,
    analog: Option<u8>,
}

impl Outputs {
    /// Connects and claims the outputs. Takes some steps of the controller.
    pub fn connect(address: &Address) -> AdapterResult<Self> {
        let limit = MonotonicClock.now().after(CONNECT);
        let mut link = open(address, limit)?;
        let (name, rate) = VALUE;
        request(&mut link, limit, &recipe(Some(rate), name), kind::OUTPUTS)?;
        let digital = claim(&mut link, limit, inputs::DIGITAL, inputs::DIGITAL_TYPES)?;
        let analog = claim(&mut link, limit, inputs::ANALOG, inputs::ANALOG_TYPES)?;
        request(&mut link, limit, &encode(kind::START, &[]), kind::START)?;
        Ok(Self { link, digital, analog })
    }

    /// Sets a digital output.
    pub fn digital(&mut self, number: u8, on: bool) -> AdapterResult<()> {
        let packet = inputs::digital(self.digital.ok_or_else(in_use)?, number, on);
        self.link.send(&packet.ok_or_else(|| no_output("digital", number))?)
    }

    /// Sets an analogue output to a fraction of its range.
    pub fn analog(&mut self, number: u8, voltage: bool, fraction: f64) -> AdapterResult<()> {
        let packet = inputs::analog(self.analog.ok_or_else(in_use)?, number, voltage, fraction);
        self.link.send(&packet.ok_or_else(|| no_output("analogue", number))?)
    }

    /// Discards what has arrived; an error if the connection is closed.
    pub fn drain(&mut self) -> AdapterResult<()> {
        self.link.drain()
    }
}

fn in_use() -> AdapterError {
    AdapterError::Rejected("another RTDE client has the outputs\nhint: end the other program that sets them".into())
}

fn no_output(kind: &str, number: u8) -> AdapterError {
    AdapterError::Rejected(format!("there is no {kind} output {number} with that value"))
}
