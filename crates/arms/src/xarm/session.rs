//! A connection to a controller: keeps the arm's state up to date from reports, without polling the joints, and sends
//! requests. Units of the wire; the adapter converts.

use std::os::fd::{AsFd, BorrowedFd};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::condition::Condition;
use super::control::{Control, Counts, Purpose};
use super::gripper::ToolGripper;
use super::mode::{ModeChange, is_ready};
use super::model::{Model, VELOCITY};
use super::protocol::commands::{Command, QUICK, SLOW};
use super::protocol::frame::Response;
use super::protocol::identity::Firmware;
use super::protocol::reduced::Reduced;
use super::protocol::report::{Health, Kind, Motion};
use super::stream::Stream;
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_core::joint::JointLimits;
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::transport::measured::Measured;

/// A live controller reports 100 or 250 times per second. Without a report for this time the connection is lost, even
/// if the socket is open.
pub const REPORT_TIMEOUT: Duration = Duration::from_millis(500);
/// How long after a response older reports may still arrive: two periods of the slower kind.
const REPORT_DELAY: Duration = Duration::from_millis(20);
/// Only a 5 Hz report shows which motors are on. Without one for this time that is unknown.
const CONDITION_TIMEOUT: Duration = Duration::from_millis(1000);
/// For this time after a setpoint, a gripper on the same connection is polled less.
const STREAMING_TIME: Duration = Duration::from_secs(2);

/// What the arm is.
pub struct Device {
    /// Model.
    pub model: Model,
    /// Firmware of the controller.
    pub firmware: Firmware,
    /// Serial number of the arm.
    pub serial: String,
    /// Joint limits.
    pub limits: JointLimits,
    /// Whether reports contain torques rather than currents.
    pub torques: bool,
}

/// State other than joints that responses and reports update.
pub(super) struct Known {
    pub(super) condition: Condition,
    pub(super) gripper: Box<dyn ToolGripper>,
    /// The newest response that a caller waits for.
    pub(super) answer: Option<Response>,
}

impl Known {
    fn take(&mut self, purpose: Purpose, response: &Response) {
        self.condition.hint(response.status);
        match purpose {
            Purpose::Health => self.condition.take(response),
            Purpose::Gripper => self.gripper.take(response),
            Purpose::Answer => self.answer = Some(*response),
            Purpose::Motion => {}
        }
    }
}

/// The arm is ready for motion in a mode that this run ordered.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Ready {
    pub(super) mode: u8,
    pub(super) since: Mono,
}

/// A connected arm.
pub struct Session {
    /// What it is.
    pub device: Device,
    pub(super) control: Control,
    /// The second control connection, for the gripper. Without it, the gripper's telegrams share `control`.
    bus: Option<Control>,
    reports: Stream<Motion>,
    normal: Stream<Health>,
    pub(super) known: Known,
    pub(super) motion: Motion,
    /// When the newest positions were measured, and when they arrived.
    pub(super) measured: Measured<7>,
    /// `None`: the arm was stopped, by this run or another client, and needs an activation.
    pub(super) ready: Option<Ready>,
    /// The ordered mode, after another client changed the mode, the state or the motors.
    pub(super) foreign: Option<u8>,
    /// When a setpoint was refused. No more are sent until a newer report arrives.
    pub(super) refused_at: Option<Mono>,
    /// When the last setpoint was sent.
    pub(super) streamed_at: Mono,
    /// A change of mode under way; it advances with every report.
    pub(super) change: Option<ModeChange>,
    /// The mode that the last change did not reach, and why, until a call reports it.
    pub(super) failed: Option<(u8, &'static str)>,
    /// When the force/torque sensor was switched on: before that, reports contain zeros for it.
    pub(super) wrench_since: Option<Mono>,
    /// The settings of reduced mode that the limits were read with.
    pub(super) limited_by: Option<Reduced>,
    updated: Mono,
}

impl Session {
    /// Starts from a first report. The arm counts as stopped until it is activated.
    pub fn new(
        device: Device,
        (control, bus): (Control, Option<Control>),
        reports: Stream<Motion>,
        first: Motion,
        normal: Stream<Health>,
        condition: Condition,
        gripper: Box<dyn ToolGripper>,
    ) -> Self {
        let arrived = reports.arrived;
        Self {
            device,
            control,
            bus,
            reports,
            normal,
            known: Known { condition, gripper, answer: None },
            measured: Measured::new(device_ns(&first), arrived),
            motion: first,
            ready: None,
            foreign: None,
            refused_at: None,
            streamed_at: Mono::ZERO,
            change: None,
            failed: None,
            wrench_since: None,
            limited_by: condition.reduced,
            updated: arrived,
        }
    }

    /// Returns the descriptor that becomes readable when a report has arrived.
    pub fn fd(&self) -> BorrowedFd<'_> {
        self.reports.as_fd()
    }

    /// Returns the newest report, and when its positions were measured.
    pub fn motion(&self) -> (&Motion, Mono) {
        (&self.motion, self.measured.stamp)
    }

    /// Returns the rate of the reports [Hz].
    pub fn rate(&self) -> f64 {
        self.reports.kind().rate()
    }

    /// Returns whether the reported joint positions are the commanded ones: port 30003 with firmware before 2.4.0.
    pub fn reports_commanded(&self) -> bool {
        self.reports.kind() == Kind::Real && !self.device.firmware.at_least(2, 4, 0)
    }

    /// Returns the controller's condition.
    pub fn condition(&self) -> &Condition {
        &self.known.condition
    }

    /// The gripper.
    pub fn gripper(&mut self) -> &mut dyn ToolGripper {
        &mut *self.known.gripper
    }

    /// Returns the counts of requests.
    pub fn counts(&self) -> Counts {
        self.control.counts()
    }

    /// Returns force and torque at the sensor [N, Nm], once it is switched on.
    pub fn wrench(&self) -> Option<[f64; 6]> {
        let measured = |since| self.measured.arrived.since(since) > REPORT_DELAY;
        self.motion.wrench.filter(|_| self.wrench_since.is_some_and(measured))
    }

    /// Returns whether all motors are on.
    pub fn enabled(&self) -> bool {
        self.known.condition.all_enabled(self.device.model.axes())
    }

    /// Closes the connections and discards unsent bytes.
    pub fn abort(self) {
        self.control.abort();
        self.bus.into_iter().for_each(Control::abort);
    }

    /// Processes all that has arrived, without waiting, and sends requests that are due. Does nothing within `age` of
    /// the previous call.
    pub fn update(&mut self, age: Duration) -> AdapterResult<()> {
        let now = MonotonicClock.now();
        if now.since(self.updated) < age {
            return Ok(());
        }
        self.updated = now;
        self.receive()?;
        if MonotonicClock.now().since(self.measured.arrived) > REPORT_TIMEOUT {
            return Err(AdapterError::Io(format!("{} sent nothing new for {REPORT_TIMEOUT:?}", self.reports.peer())));
        }
        if MonotonicClock.now().since(self.normal.arrived) > CONDITION_TIMEOUT {
            return Err(AdapterError::Io(format!("{} sent nothing for {CONDITION_TIMEOUT:?}", self.normal.peer())));
        }
        self.advance_change()?;
        // The controller answers in order: a request behind a slow one would delay the next setpoint.
        if !self.control.waits()
            && let Some(question) = self.known.condition.due(now, self.control.last_sent())
        {
            self.control.post(&question, Purpose::Health)?;
        }
        self.ask_gripper(now)
    }

    /// Processes all that has arrived, without waiting.
    pub(super) fn receive(&mut self) -> AdapterResult<()> {
        if let Some(motion) = self.reports.newest()? {
            self.take(motion);
        }
        if let Some(health) = self.normal.newest()? {
            self.known.condition.report(health);
        }
        while let Some((purpose, response)) = self.control.next()? {
            self.known.take(purpose, &response);
        }
        if self.ready.is_some_and(|ready| self.control.not_ready_after(ready.since)) {
            self.changed_by_another_client();
        }
        Ok(())
    }

    /// Sends the gripper's next telegram and processes its responses. If the control box closes the second connection,
    /// the gripper uses the first one, as with older boxes.
    fn ask_gripper(&mut self, now: Mono) -> AdapterResult<()> {
        let Known { gripper, .. } = &mut self.known;
        if let Some(bus) = &mut self.bus {
            let mut talk = || -> AdapterResult<()> {
                while let Some((_, response)) = bus.next()? {
                    gripper.take(&response);
                }
                let request = gripper.due(now, false);
                request.map_or(Ok(()), |request| bus.post(&request, Purpose::Gripper).map(drop))
            };
            if talk().is_err() {
                self.bus = None;
                gripper.unplugged();
            }
            return Ok(());
        }
        let streams = now.since(self.streamed_at) < STREAMING_TIME;
        match gripper.due(now, streams) {
            Some(request) => self.control.post(&request, Purpose::Gripper).map(drop),
            None => Ok(()),
        }
    }

    fn take(&mut self, motion: Motion) {
        if motion.time_us.is_some() && motion.time_us == self.motion.time_us {
            return; // the same measurement again
        }
        let (last, time, arrived) = (&self.motion.position, device_ns(&motion), self.reports.arrived);
        if !self.measured.take(&motion.position, last, VELOCITY, time, arrived) {
            return;
        }
        self.motion = motion;
        if self.ready.is_some_and(|ready| !is_ready(motion.state) || motion.mode != ready.mode) {
            self.changed_by_another_client();
        }
    }

    /// Records that the arm is not as this run ordered. Nothing more is commanded, and nothing is undone. Register 15
    /// shows whether the device itself is the cause.
    pub(super) fn changed_by_another_client(&mut self) {
        self.foreign = self.ready.take().map(|ready| ready.mode);
        self.known.condition.doubt(MonotonicClock.now());
    }

    /// Waits for the next report or response, at most 5 ms.
    fn pause(&self) {
        let timeout = Timespec { tv_sec: 0, tv_nsec: 5_000_000 };
        let fds = [self.fd(), self.control.fd()];
        let _ = poll(&mut fds.map(|fd| PollFd::from_borrowed_fd(fd, PollFlags::IN)), Some(&timeout));
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

    /// Sends a request whose response a caller waits for, and returns its number.
    pub(super) fn request(&mut self, command: &Command) -> AdapterResult<u16> {
        self.known.answer = None; // numbers repeat
        self.control.post(command, Purpose::Answer)
    }

    /// Returns the response with this number, if it has arrived.
    pub(super) fn answer(&self, number: u16) -> Option<Response> {
        self.known.answer.filter(|answer| answer.transaction == number)
    }

    /// Sends a request and waits for the response. Processes reports meanwhile if the request may be slow.
    pub(super) fn ask(&mut self, command: &Command) -> AdapterResult<Response> {
        // The response comes after that of a slow request that is still outstanding.
        let limit = if self.control.waits() { command.timeout().max(SLOW) } else { command.timeout() };
        if limit <= QUICK {
            let known = &mut self.known;
            let response = self.control.ask(command, limit, |purpose, response| known.take(purpose, response))?;
            self.known.condition.hint(response.status);
            return Ok(response);
        }
        let number = self.request(command)?;
        self.wait(limit, |session| Ok(session.answer(number)))?.ok_or_else(|| {
            let (peer, register) = (self.control.peer(), command.register());
            AdapterError::Timeout(format!("{peer} did not answer register {register} within {limit:?}"))
        })
    }

    /// Requests the error code; `Fault` if there is an error.
    pub fn check_error(&mut self) -> AdapterResult<()> {
        let answer = self.ask(&Command::GetError)?;
        self.known.condition.take(&answer);
        self.fault()
    }

    /// Returns `Fault` if an error is known.
    pub(super) fn fault(&self) -> AdapterResult<()> {
        match self.known.condition.error {
            0 => Ok(()),
            code => Err(AdapterError::Fault { code: code.into(), text: self.known.condition.text() }),
        }
    }
}

/// Returns the control box's own time of a report [ns].
fn device_ns(motion: &Motion) -> Option<u64> {
    motion.time_us.map(|us| us.saturating_mul(1000))
}
