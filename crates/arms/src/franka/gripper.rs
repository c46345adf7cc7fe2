//! The hand: its own connection, to the next port.

use std::time::Duration;

use super::Options;
use super::messages::HAND_STATES;
use super::protocol::gripper::{Request, STATE, VERSION, request, scan, state};
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::transport::tcp::{Endpoint, TcpLink};
use dimos_hardware::transport::udp::UdpLink;

/// Timeout of the connection and of its answer.
const ANSWER: Duration = Duration::from_millis(700);
/// The width is unknown after this time without a state.
const STALE: Duration = Duration::from_millis(500);
/// Widths below this close the hand [m].
const CLOSED: f64 = 0.001;
/// Forces that can be commanded: the largest is the continuous one of the data sheet [N].
pub const FORCES: (f64, f64) = (1.0, 70.0);
/// Speed at which each finger moves 0.05 m/s, the largest of the data sheet [m/s].
const TOP_SPEED: f64 = 0.1;
/// Widest opening according to the data sheet [m].
pub const RANGE: (f64, f64) = (0.0, 0.08);

/// A connected hand.
pub struct Hand {
    tcp: TcpLink,
    udp: UdpLink,
    last_id: u32,
    /// Width, largest width [m], and when they came.
    newest: Option<(f64, f64, Mono)>,
    /// Speed for a command without one, and for the next command [m/s].
    default_speed: f64,
    speed: f64,
    force: f64,
    grasped: bool,
}

impl Hand {
    /// Connects to the hand of the arm at `arm`.
    pub fn connect(arm: &Endpoint, options: &Options) -> AdapterResult<Self> {
        let at = Endpoint { host: arm.host.clone(), port: arm.port.saturating_add(1) };
        let mut tcp = TcpLink::connect("franka gripper", &at, ANSWER)?;
        let io = |e: std::io::Error| AdapterError::Io(format!("franka gripper at {at}: cannot receive states: {e}"));
        let (here, _) = tcp.addresses().map_err(io)?;
        let udp = UdpLink::bind((here.ip(), 0), HAND_STATES).map_err(io)?;
        udp.set_nonblocking(true).map_err(io)?;
        tcp.send(&request(1, Request::Connect(udp.local_addr().map_err(io)?.port())))?;
        match tcp.receive(ANSWER, scan)? {
            (_, 0) => {}
            _ => {
                let what = format!("franka gripper at {at}: it has another version of the interface than {VERSION}");
                return Err(AdapterError::Rejected(what));
            }
        }
        let (speed, force) = (options.gripper_speed, options.gripper_force);
        Ok(Self { tcp, udp, last_id: 1, newest: None, default_speed: speed, speed, force, grasped: false })
    }

    fn update(&mut self) -> AdapterResult<()> {
        let mut buffer = [0; 2 * STATE];
        for _ in 0..64 {
            let Ok(length) = self.udp.recv(&mut buffer) else { break };
            if let Some((width, most, grasped)) = state(buffer.get(..length).unwrap_or_default()) {
                self.newest = Some((width, most, MonotonicClock.now()));
                self.grasped = grasped;
            }
        }
        // Answers come when a motion ends; the width shows how.
        while self.tcp.poll(scan)?.is_some() {}
        Ok(())
    }

    fn known(&self) -> Option<(f64, f64)> {
        let (width, most, at) = self.newest?;
        (MonotonicClock.now().since(at) < STALE).then_some((width, most))
    }

    /// Returns the width [m], if it is known.
    pub fn width(&mut self) -> AdapterResult<Option<f64>> {
        self.update()?;
        Ok(self.known().map(|(width, _)| width))
    }

    /// Returns whether it reports an object in its grip, if that is known.
    pub fn grasps(&self) -> Option<bool> {
        self.known().map(|_| self.grasped)
    }

    /// Sets the speed of the next commands, as a fraction of the largest; `None`: that of the blueprint.
    pub fn set_speed(&mut self, fraction: Option<f64>) {
        self.speed = fraction.map_or(self.default_speed, |fraction| fraction * TOP_SPEED);
    }

    /// Moves the fingers to a width [m]; with a force [N] it grasps what is between them. Closing always grasps, by
    /// default with the force of the blueprint.
    pub fn move_to(&mut self, width: f64, force: Option<f64>) -> AdapterResult<()> {
        if let Some(force) = force.filter(|force| !(FORCES.0..=FORCES.1).contains(force)) {
            let what = format!("the gripper grasps with {} to {} N, not {force} N", FORCES.0, FORCES.1);
            return Err(AdapterError::Rejected(what));
        }
        self.update()?;
        let (_, most) = self.known().ok_or_else(|| AdapterError::Timeout("the gripper sends no state".into()))?;
        if most <= 0.0 {
            let what = "the gripper was not homed since it was switched on\nhint: home it in the vendor's Desk";
            return Err(AdapterError::Rejected(what.into()));
        }
        if !(0.0..=most + CLOSED).contains(&width) {
            return Err(AdapterError::Rejected(format!("the gripper opens 0 to {most:.3} m, not {width} m")));
        }
        self.last_id = self.last_id.wrapping_add(1);
        let closing = (width < CLOSED && self.force > 0.0).then_some(self.force);
        let order = match force.or(closing) {
            Some(force) => Request::Grasp(width.min(most), self.speed, force),
            None => Request::Move(width.min(most), self.speed),
        };
        self.tcp.send(&request(self.last_id, order))
    }
}
