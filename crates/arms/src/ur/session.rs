//! A connection to a controller: keeps the arm's state up to date, and the program on the controller alive.

use std::os::fd::{AsFd, BorrowedFd};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::address::Address;
use super::dashboard::{Dashboard, Panel};
use super::model::Model;
use super::outputs::Outputs;
use super::primary::Primary;
use super::protocol::inputs::Order;
use super::protocol::state::State;
use super::protocol::status::{self, bits, program, robot};
use super::rtde::Rtde;
use super::safety::Stopped;
use dimos_core::arm::FactoryKinematics;
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_core::joint::JointLimits;
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::transport::measured::Measured;

/// A live controller sends its state 125 or 500 times per second. Without one for this time the connection is lost,
/// even if the socket is open.
const STATE_TIMEOUT: Duration = Duration::from_millis(500);
/// Without a setpoint for this time, and then this often, the arm is ordered to hold: the program, which decelerates
/// after its own, shorter tolerance, ends when no orders come. A setpoint is never repeated, for it would be late.
const HEARTBEAT: Duration = Duration::from_millis(60);
/// A program that does not answer orders for this time has failed.
const ANSWER_TIMEOUT: Duration = Duration::from_millis(500);
/// Time between two reads of the primary interface.
const PRIMARY_PERIOD: Duration = Duration::from_millis(20);
/// Timeout of a new connection to it.
const PRIMARY_CONNECT: Duration = Duration::from_secs(1);
/// Joints slower than this are at rest [rad/s].
const REST: f64 = 0.03;

/// What the arm is.
pub struct Device {
    /// Model.
    pub model: Model,
    /// Software of the controller.
    pub software: String,
    /// Serial number, if it is known.
    pub serial: Option<String>,
    /// Dimensions.
    pub kinematics: FactoryKinematics,
    /// What a user must know of it.
    pub warning: Option<&'static str>,
    /// Joint limits.
    pub limits: JointLimits,
}

/// The first major version of PolyScope X.
pub(super) const POLYSCOPE_X: u32 = 10;

/// A connected arm.
pub struct Session {
    /// What it is.
    pub device: Device,
    pub(super) address: Address,
    pub(super) rtde: Rtde,
    /// `None` after the controller closed it, until the next program.
    pub(super) primary: Option<Primary>,
    /// Opened when the first output is set.
    outputs: Option<Outputs>,
    /// The newest state, when it was measured, and when it came.
    pub(super) state: State,
    pub(super) measured: Measured<6>,
    updated: Mono,
    primary_at: Mono,
    /// The present stop by the safety system.
    pub(super) stopped: Option<Stopped>,
    /// The last order of the present reset to the dashboard, when it was sent, and its answer.
    pub(super) asked: Option<(&'static str, Mono, AdapterResult<()>)>,
    /// Number of our program, while it runs and takes orders.
    pub(super) ready: Option<i32>,
    /// Why it no longer does, if this run did not order that.
    pub(super) ended: Option<&'static str>,
    /// It is to end, in case that it is only paused: it would continue.
    pub(super) end_due: bool,
    /// The last order: its count, what it was, when it was sent, and since when none has been answered.
    pub(super) count: i32,
    pub(super) last: Order,
    sent_at: Mono,
    pub(super) unanswered: Option<Mono>,
    /// Values of the last order that had some: its positions or velocities.
    values: [f64; 6],
}

impl Session {
    /// Starts from a first state. The arm counts as stopped until it is activated.
    pub fn new(device: Device, address: Address, rtde: Rtde, primary: Primary, first: State) -> Self {
        let arrived = rtde.arrived;
        let mut session = Self {
            device,
            address,
            rtde,
            primary: Some(primary),
            outputs: None,
            state: first,
            measured: Measured::new(Some(nanoseconds(first.time)), arrived),
            updated: Mono::ZERO,
            primary_at: Mono::ZERO,
            stopped: None,
            asked: None,
            ready: None,
            ended: None,
            end_due: false,
            // Not that of an order which the registers still hold.
            count: first.count.wrapping_add(1000),
            last: Order::Hold,
            sent_at: Mono::ZERO,
            unanswered: None,
            values: first.position,
        };
        session.see_safety();
        session
    }

    /// Returns the descriptor that becomes readable when a state has arrived.
    pub fn fd(&self) -> BorrowedFd<'_> {
        self.rtde.as_fd()
    }

    /// Returns the newest state, and when it was measured.
    pub fn state(&self) -> (&State, Mono) {
        (&self.state, self.measured.stamp)
    }

    /// Returns whether the motors are on and the brakes released.
    pub fn enabled(&self) -> bool {
        self.state.robot_mode == robot::RUNNING
    }

    /// Returns whether there is a program: it runs, is paused, or changes between that.
    pub(super) fn program_exists(&self) -> bool {
        self.state.status & bits::PROGRAM_RUNNING != 0 || self.state.runtime != status::STOPPED
    }

    /// Returns whether a program runs.
    pub(super) fn program_runs(&self) -> bool {
        self.state.runtime == status::PLAYING
    }

    /// Returns whether the controller keeps the inertia of the payload.
    pub(super) fn keeps_inertia(&self) -> bool {
        let [major, minor, _] = self.rtde.software;
        (major, minor) >= (5, 10)
    }

    /// Returns whether all joints are at rest, and commanded to be.
    pub(super) fn at_rest(&self) -> bool {
        self.state.velocity.iter().chain(&self.state.target_velocity).all(|v| v.abs() < REST)
    }

    /// Returns what takes orders besides motion.
    pub(super) fn panel(&self) -> AdapterResult<Panel> {
        const TIMEOUT: Duration = Duration::from_millis(800);
        match self.rtde.software {
            [major, ..] if major >= POLYSCOPE_X => Ok(Panel::RobotApi(self.address.clone(), TIMEOUT)),
            _ => Dashboard::connect(&self.address, TIMEOUT).map(Panel::Dashboard),
        }
    }

    /// Processes all that has arrived, without waiting, and keeps the program alive. Does nothing within `age` of the
    /// previous call.
    pub fn update(&mut self, age: Duration) -> AdapterResult<()> {
        let now = MonotonicClock.now();
        if now.since(self.updated) < age {
            return Ok(());
        }
        self.updated = now;
        if let Some(state) = self.rtde.newest()? {
            self.take(state);
        }
        let now = MonotonicClock.now();
        if now.since(self.measured.arrived) > STATE_TIMEOUT {
            return Err(AdapterError::Io(format!("ur at {} sent no new state for {STATE_TIMEOUT:?}", self.address)));
        }
        if now.since(self.primary_at) > PRIMARY_PERIOD || self.stopped.is_some_and(|stopped| stopped.error.is_none()) {
            self.primary_at = now;
            self.read_primary()?;
            if self.outputs.as_mut().is_some_and(|outputs| outputs.drain().is_err()) {
                self.outputs = None;
            }
        }
        if self.unanswered.is_some_and(|since| now.since(since) > ANSWER_TIMEOUT) {
            self.lose_program("the program on the controller does not answer");
        }
        if std::mem::take(&mut self.end_due) {
            self.order(Order::Stop)?;
            self.unanswered = None;
        }
        self.keep_alive(now)
    }

    /// Processes what has arrived on the primary interface. Controllers close it when the pendant takes control; the
    /// state is not affected.
    fn read_primary(&mut self) -> AdapterResult<()> {
        match self.primary.as_mut().map(Primary::update) {
            Some(Ok(())) => self.see_error(),
            Some(Err(_)) => {
                self.primary = None;
                // A controller that closes all connections is another matter.
                if let Some(state) = self.rtde.newest()? {
                    self.take(state);
                }
                self.lose_program("the pendant took control, or the controller closed the primary interface");
            }
            None => {}
        }
        Ok(())
    }

    /// Sends a program, over a new connection where the controller closed the last one.
    pub(super) fn run_program(&mut self, text: &str) -> AdapterResult<()> {
        if self.primary.as_mut().is_none_or(|primary| primary.update().is_err() || primary.read_only()) {
            let (primary, ..) =
                Primary::connect(&self.address, MonotonicClock.now().after(PRIMARY_CONNECT), Duration::ZERO)
                    .map_err(refused)?;
            self.primary = Some(primary);
        }
        self.primary.as_mut().map_or(Ok(()), |primary| primary.run(text)).map_err(refused)
    }

    /// Returns an error if the controller has refused the program that was sent.
    pub(super) fn check_program(&mut self) -> AdapterResult<()> {
        let Some(primary) = &mut self.primary else {
            return Err(AdapterError::Rejected("the controller closed the primary interface".into()));
        };
        let checked = primary.check();
        let read_only = primary.read_only();
        if read_only || matches!(checked, Err(AdapterError::Io(_))) {
            self.primary = None;
        }
        match checked {
            Err(AdapterError::Io(text)) => Err(AdapterError::Rejected(text)),
            Ok(()) if read_only => Err(AdapterError::Rejected(
                "the controller takes no programs from a connection that was opened in local control\nhint: select \
                 remote control at the pendant, then enable the arm again"
                    .into(),
            )),
            checked => checked,
        }
    }

    /// Calls `act` with the outputs, which are claimed first. What breaks there leaves the state and the orders alone.
    pub(super) fn with_outputs(&mut self, act: impl FnOnce(&mut Outputs) -> AdapterResult<()>) -> AdapterResult<()> {
        if self.outputs.is_none() {
            self.outputs = Some(Outputs::connect(&self.address).map_err(refused)?);
        }
        let done = self.outputs.as_mut().map_or(Ok(()), act);
        if done.is_err() {
            self.outputs = None;
        }
        done.map_err(refused)
    }

    /// Takes a state.
    fn take(&mut self, state: State) {
        if state.time == self.state.time {
            return; // the same measurement again
        }
        let arrived = self.rtde.arrived;
        let top = self.device.limits.velocity_max.iter().copied().fold(0.0, f64::max);
        let time = Some(nanoseconds(state.time));
        if !self.measured.take(&state.position, &self.state.position, top, time, arrived) {
            return;
        }
        // Every new echo is an answer. That of the newest order comes later than the next order.
        let echoed = state.count != self.state.count && self.count.wrapping_sub(state.count) >= 0;
        let passed = Duration::from_secs_f64((state.time - self.state.time).clamp(0.0, STATE_TIMEOUT.as_secs_f64()));
        self.state = state;
        // A step of servoj takes longer by the fraction: the program answers so much later.
        let slowed = passed.mul_f64(1.0 - self.speed_fraction());
        self.unanswered = self.unanswered.map(|since| since.after(slowed));
        if state.count == self.count {
            self.unanswered = None;
        } else if echoed && self.unanswered.is_some() {
            self.unanswered = Some(arrived);
        }
        self.see_safety();
        self.see_program();
    }

    /// Checks that our program still runs.
    fn see_program(&mut self) {
        let Some(number) = self.ready else { return };
        let state = &self.state;
        if !self.enabled() {
            self.ready = None; // the motors' state says it
        } else if state.number == number && state.program == program::SILENT {
            self.lose_program(
                "no order reached the program on the controller for 1 s: it decelerated after 20 ms, and has ended",
            );
        } else if state.number == number && state.program == program::FAR {
            self.lose_program("a setpoint was farther away than the arm moves in 0.2 s: the program ended");
        } else if matches!(state.runtime, status::PAUSED | status::PAUSING) {
            self.lose_program("the program on the controller was paused");
        } else if !self.program_runs() || state.number != number || state.program >= program::STOPPED {
            self.lose_program("another client or the pendant ended the program on the controller");
        }
    }

    /// Records that the program takes no more orders. It ends if it still runs.
    fn lose_program(&mut self, why: &'static str) {
        self.unanswered = None;
        if self.ready.take().is_some() {
            (self.ended, self.end_due) = (Some(why), true);
        }
    }

    /// Holds the arm where no setpoints come.
    fn keep_alive(&mut self, now: Mono) -> AdapterResult<()> {
        if self.ready.is_none() || now.since(self.sent_at) < HEARTBEAT {
            return Ok(());
        }
        self.order(Order::Hold)
    }

    /// Sends an order.
    pub(super) fn order(&mut self, order: Order) -> AdapterResult<()> {
        self.count = self.count.wrapping_add(1);
        self.rtde.order(self.count, order, &self.values)?;
        self.values = order.values().unwrap_or(self.values);
        self.sent_at = MonotonicClock.now();
        self.unanswered.get_or_insert(self.sent_at);
        self.last = order;
        Ok(())
    }

    /// Waits for the next state, at most 5 ms.
    fn pause(&self) {
        let timeout = Timespec { tv_sec: 0, tv_nsec: 5_000_000 };
        let _ = poll(&mut [PollFd::from_borrowed_fd(self.fd(), PollFlags::IN)], Some(&timeout));
    }

    /// Processes what arrives until `done` returns a value; `None` after `limit`.
    pub(super) fn wait<T>(
        &mut self,
        limit: Duration,
        mut done: impl FnMut(&mut Self) -> AdapterResult<Option<T>>,
    ) -> AdapterResult<Option<T>> {
        let until = MonotonicClock.now().after(limit);
        loop {
            self.update(Duration::ZERO)?;
            if let Some(found) = done(self)? {
                return Ok(Some(found));
            }
            if MonotonicClock.now() >= until {
                return Ok(None);
            }
            self.pause();
        }
    }

    /// Closes the connections, and discards unsent bytes.
    pub fn abort(self) {
        self.rtde.abort(self.count.wrapping_add(1), &self.values);
    }

    /// Returns what another client, or a person at the pendant, changed. `None` during a stop by the safety system.
    pub fn foreign_change(&self) -> Option<&'static str> {
        self.ended.filter(|_| self.stopped.is_none())
    }
}

/// An error of a connection other than that of the state and the orders, which it does not break.
fn refused(error: AdapterError) -> AdapterError {
    match error {
        AdapterError::Io(text) => AdapterError::Rejected(text),
        other => other,
    }
}

fn nanoseconds(seconds: f64) -> u64 {
    (seconds * 1e9) as u64
}
