//! The RTDE connection: the controller's state in, orders and outputs out.

use std::os::fd::{AsFd, BorrowedFd};
use std::time::Duration;

use super::address::{Address, Service};
use super::protocol::inputs::{self, Order};
use super::protocol::rtde::{Arrived, VERSION, data, encode, kind, recipe, reply};
use super::protocol::state::{Recipe, State};
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::transport::tcp::TcpLink;

/// Timeout of a reply.
const REPLY: Duration = Duration::from_millis(700);

/// A connection that was started.
pub struct Rtde {
    link: TcpLink,
    recipe: Recipe,
    /// Number of the input recipe of orders; `None`: another client has the registers.
    orders: Option<u8>,
    /// Software of the controller: major, minor, bugfix.
    pub software: [u32; 3],
    /// When the newest state was taken.
    pub arrived: Mono,
}

fn until(limit: Mono, most: Duration) -> Duration {
    limit.since(MonotonicClock.now()).min(most)
}

/// Sends a request and waits for the reply of the same kind.
pub fn request(link: &mut TcpLink, limit: Mono, packet: &[u8], kind: u8) -> AdapterResult<Vec<u8>> {
    link.send(packet)?;
    link.receive(until(limit, REPLY), |bytes| reply(bytes, kind, <[u8]>::to_vec))
}

/// Connects, and agrees on the version of the protocol.
pub fn open(address: &Address, limit: Mono) -> AdapterResult<TcpLink> {
    let mut link = TcpLink::connect("ur", &address.port(Service::Rtde), until(limit, 2 * REPLY))?;
    match request(&mut link, limit, &encode(kind::PROTOCOL, &VERSION.to_be_bytes()), kind::PROTOCOL)?[..] {
        [1] => Ok(link),
        _ => Err(AdapterError::Protocol(format!(
            "the controller refuses version {VERSION} of RTDE: its software is too old (3.9 or 5.3 is needed)"
        ))),
    }
}

/// Claims inputs; returns the number of their recipe, or `None` if another client has one of them.
pub fn claim(link: &mut TcpLink, limit: Mono, names: &str, types: &str) -> AdapterResult<Option<u8>> {
    let answer = request(link, limit, &recipe(None, names), kind::INPUTS)?;
    let (id, found) = answer.split_first().ok_or_else(|| malformed("inputs"))?;
    Ok((found == types.as_bytes()).then_some(*id))
}

impl Rtde {
    /// Connects, agrees on the values, and starts the state.
    pub fn connect(address: &Address, limit: Mono) -> AdapterResult<Self> {
        let mut link = open(address, limit)?;
        let mut ask = |packet: &[u8], kind: u8| request(&mut link, limit, packet, kind);
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
        let orders = claim(&mut link, limit, inputs::ORDER, inputs::ORDER_TYPES)?;
        if request(&mut link, limit, &encode(kind::START, &[]), kind::START)? != [1] {
            return Err(AdapterError::Protocol("the controller does not start its RTDE data".into()));
        }
        Ok(Self { link, recipe: fields, orders, software, arrived: MonotonicClock.now() })
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

    /// Returns whether the controller sends a value: older software lacks some.
    pub fn has(&self, name: &str) -> bool {
        self.recipe.has(name)
    }

    /// Returns whether orders can be sent: no other client has the registers.
    pub fn takes_orders(&self) -> bool {
        self.orders.is_some()
    }

    /// Sends an order; `last` are the values of the order before.
    pub fn order(&mut self, count: i32, order: Order, last: &[f64; 6]) -> AdapterResult<()> {
        let id = self.orders.ok_or_else(in_use)?;
        self.link.send(&inputs::order(id, count, order, last))
    }

    /// Sends a last order as far as possible without blocking, closes the connection and discards the rest.
    pub fn abort(mut self, count: i32, last: &[f64; 6]) {
        if let Some(id) = self.orders {
            self.link.send_now(&inputs::order(id, count, Order::Stop, last));
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
