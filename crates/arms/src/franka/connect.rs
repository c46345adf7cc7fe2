//! Connecting: identifies the arm and compares it with the blueprint. Enables and moves nothing.

use std::net::SocketAddr;
use std::time::Duration;

use super::Options;
use super::description;
use super::messages::STATES;
use super::model::Model;
use super::protocol::Interface;
use super::protocol::service::{Reader, Service, connect as connect_values, request};
use super::protocol::state::State;
use super::session::Session;
use super::shaping::Shaping;
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::transport::tcp::{Endpoint, TcpLink};
use dimos_hardware::transport::udp::UdpLink;

/// Timeouts of the connection, of its answer, and of the first state.
const CONNECT: Duration = Duration::from_millis(1000);
const ANSWER: Duration = Duration::from_millis(700);
const FIRST_STATE: Duration = Duration::from_millis(700);

/// Connects to the arm at `address`.
pub fn connect(address: &Endpoint, options: &Options) -> AdapterResult<Session> {
    let model = options.model;
    let interface = model.interface();
    let mut tcp = TcpLink::connect("franka", address, CONNECT)?;
    let io = |e: std::io::Error| AdapterError::Io(format!("franka at {address}: cannot receive states: {e}"));
    let (here, peer) = tcp.addresses().map_err(io)?;
    let udp = UdpLink::bind((here.ip(), 0), STATES).map_err(io)?;
    let port = udp.local_addr().map_err(io)?.port();
    tcp.send(&request(interface, Service::Connect, 1, &connect_values(interface, port)))?;
    agree(&mut tcp, model, address)?;
    let (first, source) = first_state(&udp, interface, peer, address)?;
    udp.connect(source).and_then(|()| udp.set_nonblocking(true)).map_err(io)?;
    let limits = options.limit_rate.then(|| model.ranges());
    let mut session = Session::new(model, tcp, udp, first, Shaping::new(options.cutoff_frequency, limits));
    if interface == Interface::Ten {
        describe(&mut session, address)?;
    }
    Ok(session)
}

/// Waits for the answer to Connect: both sides must have the same version.
fn agree(tcp: &mut TcpLink, model: Model, address: &Endpoint) -> AdapterResult<()> {
    let mut reader = Reader::default();
    let until = MonotonicClock.now().after(ANSWER);
    loop {
        let left = until.since(MonotonicClock.now());
        let Some(answer) = tcp.receive(left, |bytes| reader.scan(bytes))?.filter(|answer| answer.id == 1) else {
            continue;
        };
        if answer.status == 0 {
            return Ok(());
        }
        let found = answer.rest.first_chunk().map_or(0, |version| u16::from_le_bytes(*version));
        return Err(AdapterError::Rejected(format!(
            "franka at {address}: the model {} has version {} of the interface, this controller has version {found}\n\
             hint: is `options.model` right? Versions 6 to 9 are older systems of an FR3: update it",
            model.name(),
            model.interface().version()
        )));
    }
}

/// Waits for the first state. Returns where it came from, too: answers go there.
fn first_state(
    udp: &UdpLink,
    interface: Interface,
    peer: SocketAddr,
    address: &Endpoint,
) -> AdapterResult<(State, SocketAddr)> {
    let until = MonotonicClock.now().after(FIRST_STATE);
    let mut buffer = [0; 2400];
    loop {
        let left = until.since(MonotonicClock.now());
        if left.is_zero() {
            let what =
                format!("franka at {address} sends no state\nhint: does a firewall block UDP from the controller?");
            return Err(AdapterError::Timeout(what));
        }
        let _ = udp.set_read_timeout(Some(left.max(Duration::from_millis(1))));
        let Ok((length, source)) = udp.recv_from(&mut buffer) else { continue };
        let state = State::decode(interface, buffer.get(..length).unwrap_or_default());
        if let Some(state) = state.filter(|_| source.ip() == peer.ip()) {
            return Ok((state, source));
        }
    }
}

/// Takes the limits from the robot's own description, and checks which robot it is.
fn describe(session: &mut Session, address: &Endpoint) -> AdapterResult<()> {
    let answer = session.ask(Service::GetRobotModel, &[])?;
    let urdf = String::from_utf8_lossy(&answer.rest);
    let (wanted, found) = (session.model.name(), description::name(&urdf).unwrap_or("a robot without a name"));
    if !found.to_ascii_uppercase().starts_with(wanted) {
        return Err(AdapterError::Rejected(format!(
            "franka at {address}: expected the model {wanted}, found {found}\nhint: is the address right?"
        )));
    }
    let ranges = description::ranges(&urdf, session.model).ok_or_else(|| {
        AdapterError::Protocol(format!("franka at {address}: the description of the robot lacks joint limits"))
    })?;
    session.ranges = ranges;
    if session.shaping.limits.is_some() {
        session.shaping.limits = Some(ranges);
    }
    Ok(())
}
