//! The RTDE connection: the controller's state in, orders and outputs out.

use std::os::fd::{AsFd, BorrowedFd};
use std::time::Duration;

use super::address::{Address, Service};
use super::protocol::inputs::{self, Order};
use super::protocol::rtde::{Arrived, VERSION, data, encode, kind, recipe, reply};
use super::protocol::state::{Recipe, State};
use crate::clock::{Clock, Mono, MonotonicClock};
use crate::hardware::adapter::{AdapterError, AdapterResult};
use crate::hardware::transport::tcp::TcpLink;

/// Timeout of a reply.
const REPLY: Duration = Duration::from_millis(700);

/// A connection that was started.
pub struct Rtde {
    link: TcpLink,
    recipe: Recipe,
    /// Numbers of the input recipes: orders, digital and analog outputs; `None`: another client has them.
    orders: Option<u8>,
    digital: Option<u8>,
    analog: Option<u8>,
    /// Software of the controller: major, minor, bugfix.
    pub software: [u32; 3],
    /// When the newest state was taken.
    pub arrived: Mono,
}

fn until(limit: Mono, most: Duration) -> Duration {
    limit.since(MonotonicClock.now()).min(most)
}

impl Rtde {
    /// Connects, agrees on the values, and starts the state.
    pub fn connect(address: &Address, limit: Mono) -> AdapterResult<Self> {
        let mut link = TcpLink::connect("ur", &address.port(Service::Rtde), until(limit, 2 * REPLY))?;
        let mut ask = |request: &[u8], kind: u8| -> AdapterResult<Vec<u8>> {
            link.send(request)?;
            link.receive(until(limit, REPLY), |bytes| reply(bytes, kind, <[u8]>::to_vec))
        };
        if ask(&encode(kind::PROTOCOL, &VERSION.to_be_bytes()), kind::PROTOCOL)? != [1] {
            return Err(AdapterError::Protocol(format!(
                "the controller refuses version {VERSION} of RTDE: its software is too old (3.5 or newer is needed)"
            )));
        }
        let numbers = ask(&encode(kind::SOFTWARE, &[]), kind::SOFTWARE)?;
        let number = |i: usize| {
            let bytes = numbers.get(4 * i..4 * i + 4).and_then(|bytes| bytes.try_into().ok());
            bytes.map_or(0, u32::from_be_bytes)
        };
        let software = [0, 1, 2].map(number);
        let rate = if software[0] < 5 { 125.0 } else { 500.0 };
        let mut fields = Recipe::default();
        loop {
            let answer = ask(&recipe(Some(rate), &fields.names()), kind::OUTPUTS)?;
            let (id, types) = answer.split_first().ok_or_else(|| malformed("outputs"))?;
            match fields.agreed(*id, &String::from_utf8_lossy(types))? {
                Some(fewer) => fields = fewer,
                None => break,
            }
        }
        let mut input = |names: &str, types: &str| -> AdapterResult<Option<u8>> {
            let answer = ask(&recipe(None, names), kind::INPUTS)?;
            let (id, found) = answer.split_first().ok_or_else(|| malformed("inputs"))?;
            Ok((found == types.as_bytes()).then_some(*id))
        };
        let orders = input(inputs::ORDER, inputs::ORDER_TYPES)?;
        let digital = input(inputs::DIGITAL, inputs::DIGITAL_TYPES)?;
        let analog = input(inputs::ANALOG, inputs::ANALOG_TYPES)?;
        if ask(&encode(kind::START, &[]), kind::START)? != [1] {
            return Err(AdapterError::Protocol("the controller does not start its RTDE data".into()));
        }
        Ok(Self { link, recipe: fields, orders, digital, analog, software, arrived: MonotonicClock.now() })
    }

    /// Returns the newest of the states that have arrived since the last call, without waiting.
    pub fn newest(&mut self) -> AdapterResult<Option<State>> {
        let (recipe, length, mut newest) = (self.recipe, self.recipe.length(), None);
        loop {
            match self.link.poll(|bytes| data(bytes, recipe.id, length, |content| recipe.decode(content)))? {
                Some(Arrived::Data(state)) => {
                    self.arrived = MonotonicClock.now();
                    newest = Some(state);
                }
                Some(Arrived::Other) => {}
                None => return Ok(newest),
            }
        }
    }

    /// Waits for the next state; those that have arrived before are older.
    pub fn next(&mut self, timeout: Duration) -> AdapterResult<State> {
        self.newest()?;
        let limit = MonotonicClock.now().after(timeout);
        let (recipe, length) = (self.recipe, self.recipe.length());
        loop {
            let scan = |bytes: &[u8]| data(bytes, recipe.id, length, |content| recipe.decode(content));
            if let Arrived::Data(state) = self.link.receive(until(limit, timeout), scan)? {
                self.arrived = MonotonicClock.now();
                return Ok(state);
            }
        }
    }

    /// Returns whether orders can be sent: no other client has the registers.
    pub fn takes_orders(&self) -> bool {
        self.orders.is_some()
    }

    /// Sends an order.
    pub fn order(&mut self, count: i32, order: Order) -> AdapterResult<()> {
        let id = self.orders.ok_or_else(in_use)?;
        self.link.send(&inputs::order(id, count, order))
    }

    /// Sets a digital output.
    pub fn digital(&mut self, number: u8, on: bool) -> AdapterResult<()> {
        let packet = inputs::digital(self.digital.ok_or_else(outputs_in_use)?, number, on);
        self.link.send(&packet.ok_or_else(|| no_output("digital", number))?)
    }

    /// Sets an analog output.
    pub fn analog(&mut self, number: u8, voltage: bool, fraction: f64) -> AdapterResult<()> {
        let packet = inputs::analog(self.analog.ok_or_else(outputs_in_use)?, number, voltage, fraction);
        self.link.send(&packet.ok_or_else(|| no_output("analog", number))?)
    }

    /// Sends a last order as far as possible without blocking, closes the connection and discards the rest.
    pub fn abort(mut self, count: i32) {
        if let Some(id) = self.orders {
            self.link.send_now(&inputs::order(id, count, Order::Stop));
        }
        self.link.abort();
    }
}

impl AsFd for Rtde {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.link.as_fd()
    }
}

fn malformed(what: &str) -> AdapterError {
    AdapterError::Protocol(format!("the controller's answer to the request for RTDE {what} is empty"))
}

/// Another client has the registers of orders.
pub fn in_use() -> AdapterError {
    AdapterError::Rejected(
        "another RTDE client has the input registers from 24 on\nhint: end the other program that commands this arm, or \
         a fieldbus that uses them"
            .into(),
    )
}

fn outputs_in_use() -> AdapterError {
    AdapterError::Rejected("another RTDE client has the outputs\nhint: end the other program that sets them".into())
}

fn no_output(kind: &str, number: u8) -> AdapterError {
    AdapterError::Rejected(format!("there is no {kind} output {number} with that value"))
}
