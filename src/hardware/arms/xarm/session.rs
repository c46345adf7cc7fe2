//! A connection to a controller, from connecting to its end: what is known of the arm, kept up to date without ever
//! asking for the joints, and what can be asked of it. Units of the wire; the adapter converts.

use std::os::fd::{AsFd, BorrowedFd};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::condition::Condition;
use super::control::{Control, Counts, Purpose};
use super::errors::warning_text;
use super::gripper::Gripper;
use super::mode::{ModeChange, is_ready};
use super::model::{Model, VELOCITY};
use super::protocol::commands::{Command, QUICK, SLOW};
use super::protocol::frame::{Response, Status};
use super::protocol::identity::Firmware;
use super::protocol::report::{Health, Motion};
use super::stream::Stream;
use crate::clock::{Clock, Mono, MonotonicClock};
use crate::hardware::adapter::{AdapterError, AdapterResult};
use crate::hardware::transport::device_time::DeviceTime;
use crate::joint::JointLimits;

/// A controller that lives reports 100 or 250 times a second: after so much silence, also on a connection that
/// looks well, it is gone.
pub const SILENCE: Duration = Duration::from_millis(500);
/// Reports from before an answer may still be on the way for so long after it: two periods of the slower kind.
const ON_THE_WAY: Duration = Duration::from_millis(20);
/// Which motors are on is told five times a second, and by nothing else: after so much silence that is not known.
const CONDITION_SILENCE: Duration = Duration::from_millis(1000);
/// Setpoints were streamed lately: a gripper that shares their connection is left alone as far as it can be.
const STREAMING: Duration = Duration::from_secs(2);
/// Joint positions that jump further than the arm can move, and this much [rad], are believed only when the next
/// report agrees.
const JUMP: f64 = 0.1;

/// What the arm is.
pub struct Device {
    /// Which model.
    pub model: Model,
    /// Firmware of the controller.
    pub firmware: Firmware,
    /// Serial number of the arm.
    pub serial: String,
    /// Joint limits.
    pub limits: JointLimits,
    /// Whether reports hold torques, and not currents.
    pub torques: bool,
}

/// What responses and reports are told to, besides the joints.
pub(super) struct Known {
    pub(super) condition: Condition,
    pub(super) gripper: Gripper,
    /// The newest answer to a request that a caller waits for.
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

/// What this run ordered last: an arm that is ready for motion in a mode.
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
    /// The second control connection, for the gripper; without one its telegrams share `control`.
    bus: Option<Control>,
    reports: Stream<Motion>,
    normal: Stream<Health>,
    pub(super) known: Known,
    pub(super) motion: Motion,
    /// When the newest positions were measured, and when they came.
    stamp: Mono,
    pub(super) fresh_at: Mono,
    device_time: DeviceTime,
    suspect: bool,
    /// `None`: the arm was stopped, by this run or by another client: only an activation makes it ready again.
    pub(super) ready: Option<Ready>,
    /// The mode that was ordered when another client changed the mode, the state or the motors.
    pub(super) foreign: Option<u8>,
    /// When a setpoint was refused: no more are sent before a report tells why.
    refused_at: Option<Mono>,
    /// When the last setpoint was sent.
    streamed_at: Mono,
    /// A change of mode under way: it goes on with every report, whoever asks.
    pub(super) change: Option<ModeChange>,
    /// The mode that the last change did not reach, and why, until a caller takes it.
    pub(super) failed: Option<(u8, &'static str)>,
    /// When the force/torque sensor was switched on: before that its place in the reports holds zeros.
    pub(super) wrench_since: Option<Mono>,
    updated: Mono,
}

impl Session {
    /// Begins with a first report. The arm counts as stopped until it is activated.
    pub fn new(
        device: Device,
        (control, bus): (Control, Option<Control>),
        reports: Stream<Motion>,
        first: Motion,
        normal: Stream<Health>,
        condition: Condition,
        gripper: Gripper,
    ) -> Self {
        let arrived = reports.arrived;
        let mut device_time = DeviceTime::default();
        let stamp = first.time_us.map_or(arrived, |us| device_time.translate(us.saturating_mul(1000), arrived));
        Self {
            device,
            control,
            bus,
            reports,
            normal,
            known: Known { condition, gripper, answer: None },
            motion: first,
            stamp,
            fresh_at: arrived,
            device_time,
            suspect: false,
            ready: None,
            foreign: None,
            refused_at: None,
            streamed_at: Mono::ZERO,
            change: None,
            failed: None,
            wrench_since: None,
            updated: arrived,
        }
    }

    /// Becomes readable when a report has come.
    pub fn fd(&self) -> BorrowedFd<'_> {
        self.reports.as_fd()
    }

    /// The newest report, and when its positions were measured.
    pub fn motion(&self) -> (&Motion, Mono) {
        (&self.motion, self.stamp)
    }

    /// How often it reports [Hz].
    pub fn rate(&self) -> f64 {
        self.reports.kind().rate()
    }

    /// How the controller is.
    pub fn condition(&self) -> &Condition {
        &self.known.condition
    }

    /// The gripper.
    pub fn gripper(&mut self) -> &mut Gripper {
        &mut self.known.gripper
    }

    /// What became of requests so far.
    pub fn counts(&self) -> Counts {
        self.control.counts()
    }

    /// Force and torque at the sensor [N, Nm], once that is switched on.
    pub fn wrench(&self) -> Option<[f64; 6]> {
        let measured = |since| self.fresh_at.since(since) > ON_THE_WAY;
        self.motion.wrench.filter(|_| self.wrench_since.is_some_and(measured))
    }

    /// Whether all motors are on.
    pub fn enabled(&self) -> bool {
        self.known.condition.all_enabled(self.device.model.axes())
    }

    /// Closes the connections and discards what has not left this computer.
    pub fn abort(self) {
        self.control.abort();
        self.bus.into_iter().for_each(Control::abort);
    }

    /// Takes up all that has arrived, without waiting, and asks what is due. Does nothing within `age` of the last
    /// time.
    pub fn update(&mut self, age: Duration) -> AdapterResult<()> {
        let now = MonotonicClock.now();
        if now.since(self.updated) < age {
            return Ok(());
        }
        self.updated = now;
        self.take_up()?;
        if MonotonicClock.now().since(self.fresh_at) > SILENCE {
            return Err(AdapterError::Io(format!("{} sent nothing new for {SILENCE:?}", self.reports.peer())));
        }
        if MonotonicClock.now().since(self.normal.arrived) > CONDITION_SILENCE {
            return Err(AdapterError::Io(format!("{} sent nothing for {CONDITION_SILENCE:?}", self.normal.peer())));
        }
        self.advance_change()?;
        // What is asked behind something slow waits for it, and so would the next setpoint.
        if !self.control.waits()
            && let Some(question) = self.known.condition.due(now, self.control.last_sent())
        {
            self.control.post(&question, Purpose::Health)?;
        }
        self.ask_gripper(now)
    }

    /// Takes up all that has arrived, without waiting.
    fn take_up(&mut self) -> AdapterResult<()> {
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

    /// Sends the gripper its next telegram and takes up its answers. A box may close the second connection: then the
    /// gripper has the first one, like that of an older box.
    fn ask_gripper(&mut self, now: Mono) -> AdapterResult<()> {
        let Known { gripper, .. } = &mut self.known;
        if let Some(bus) = &mut self.bus {
            let mut talk = || -> AdapterResult<()> {
                while let Some((_, response)) = bus.next()? {
                    gripper.take(&response);
                }
                let telegram = gripper.due(now, false);
                telegram.map_or(Ok(()), |telegram| bus.post(&Command::Tool(telegram), Purpose::Gripper).map(drop))
            };
            if talk().is_err() {
                self.bus = None;
                gripper.unplugged();
            }
            return Ok(());
        }
        let streams = now.since(self.streamed_at) < STREAMING;
        match gripper.due(now, streams) {
            Some(telegram) => self.control.post(&Command::Tool(telegram), Purpose::Gripper).map(drop),
            None => Ok(()),
        }
    }

    fn take(&mut self, motion: Motion) {
        if motion.time_us.is_some() && motion.time_us == self.motion.time_us {
            return; // the same measurement once more is nothing new
        }
        let arrived = self.reports.arrived;
        let reach = JUMP + 1.5 * VELOCITY * arrived.since(self.fresh_at).as_secs_f64();
        let jumps = motion.position.iter().zip(&self.motion.position).any(|(new, old)| (new - old).abs() > reach);
        if jumps && !self.suspect {
            self.suspect = true;
            return;
        }
        self.suspect = false;
        self.stamp = match motion.time_us {
            Some(us) => self.device_time.translate(us.saturating_mul(1000), arrived),
            None => arrived,
        };
        self.fresh_at = arrived;
        self.motion = motion;
        if self.ready.is_some_and(|ready| !is_ready(motion.state) || motion.mode != ready.mode) {
            self.changed_by_another_client();
        }
    }

    /// The arm is not as this run ordered: nothing is commanded any more, and nothing is undone. Register 15 tells
    /// whether the device itself is the cause.
    pub(super) fn changed_by_another_client(&mut self) {
        self.foreign = self.ready.take().map(|ready| ready.mode);
        self.known.condition.doubt(MonotonicClock.now());
    }

    /// Waits for the next report or response, a few ms at most.
    fn pause(&self) {
        let timeout = Timespec { tv_sec: 0, tv_nsec: 5_000_000 };
        let fds = [self.fd(), self.control.fd()];
        let _ = poll(&mut fds.map(|fd| PollFd::from_borrowed_fd(fd, PollFlags::IN)), Some(&timeout));
    }

    /// Takes up what arrives until `done` has what it looks for; `None` when it has not within `limit`.
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

    /// Sends a request whose answer a caller waits for.
    pub(super) fn request(&mut self, command: &Command) -> AdapterResult<u16> {
        self.known.answer = None; // numbers come again
        self.control.post(command, Purpose::Answer)
    }

    /// The answer to the request with this number, once it is there.
    pub(super) fn answer(&self, number: u16) -> Option<Response> {
        self.known.answer.filter(|answer| answer.transaction == number)
    }

    /// Asks and waits for the answer. Reports are taken up meanwhile where it may take long.
    pub(super) fn ask(&mut self, command: &Command) -> AdapterResult<Response> {
        // A quick answer comes after that to something slow that was asked before.
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

    /// Asks for the error, and answers it as such when there is one.
    pub fn check_error(&mut self) -> AdapterResult<()> {
        let answer = self.ask(&Command::GetError)?;
        self.known.condition.take(&answer);
        self.fault()
    }

    /// The known error, as such.
    pub(super) fn fault(&self) -> AdapterResult<()> {
        match self.known.condition.error {
            0 => Ok(()),
            code => Err(AdapterError::Fault { code: code.into(), text: self.known.condition.text() }),
        }
    }

    // --- Motion ---

    pub(super) fn may_be_commanded(&self) -> AdapterResult<()> {
        if !self.enabled() {
            Err(AdapterError::Rejected("the motors are disabled".into()))
        } else if self.ready.is_none() || !is_ready(self.motion.state) {
            let why = self.foreign_change().unwrap_or("the arm was stopped");
            Err(AdapterError::Rejected(format!("{why}: enable it again")))
        } else {
            Ok(())
        }
    }

    fn may_move(&mut self, mode: u8) -> AdapterResult<()> {
        self.fault()?;
        if self.change.is_some() {
            return Err(AdapterError::Rejected("the change of mode is under way".into()));
        }
        self.may_be_commanded()?;
        if self.motion.mode != mode {
            return Err(AdapterError::Rejected(format!("the arm is in mode {}, not {mode}", self.motion.mode)));
        }
        Ok(())
    }

    /// Sends a command of a stream (a setpoint, velocities) and does not wait for its response. Not when the newest
    /// report or response says that the arm is not as it was ordered to be, and not while two are on their way
    /// (`Busy`).
    pub fn stream(&mut self, mode: u8, command: &Command) -> AdapterResult<()> {
        self.take_up()?;
        self.heed_refusal()?;
        self.may_move(mode)?;
        if self.refused_at.is_some_and(|refused| self.fresh_at <= refused) {
            return Err(AdapterError::Busy);
        }
        self.control.post(command, Purpose::Motion)?;
        self.streamed_at = self.control.last_sent();
        Ok(())
    }

    /// Reports a setpoint that was refused. The response may say that the arm is not ready before the report does.
    pub(super) fn heed_refusal(&mut self) -> AdapterResult<()> {
        let Some((status, sent)) = self.control.take_refusal() else { return Ok(()) };
        if self.ready.is_none_or(|ready| sent < ready.since) && self.foreign.is_none() {
            return Ok(()); // of a setpoint before a stop or a change of mode that this run ordered
        }
        self.refused_at = Some(MonotonicClock.now());
        Err(self.refused(status))
    }

    /// Whether a move that the controller plans would be sent.
    pub fn may_plan(&mut self) -> AdapterResult<()> {
        self.may_move(0)
    }

    /// Sends a move that the controller plans, and hears what it makes of it.
    pub fn plan(&mut self, command: &Command) -> AdapterResult<()> {
        self.may_move(0)?;
        let status = self.ask(command)?.status;
        if status.error() || status.warning() {
            self.check_error()?;
        }
        if status.warning() && self.known.condition.warning != 0 {
            let code = self.known.condition.warning;
            self.ask(&Command::ClearWarning)?;
            self.known.condition.warning = 0;
            return Err(AdapterError::Rejected(format!("xarm refuses the move: {} ({code})", warning_text(code))));
        }
        if status.not_ready() && self.ready.is_some() {
            self.changed_by_another_client();
        }
        if status.not_ready() || status.invalid() { Err(self.refused(status)) } else { Ok(()) }
    }

    fn refused(&self, status: Status) -> AdapterError {
        if let Err(fault) = self.fault() {
            return fault;
        }
        if let Some(what) = self.foreign_change() {
            return AdapterError::Rejected(format!("{what}: enable it again"));
        }
        let why = match status {
            status if status.error() => "it is in error",
            status if status.not_ready() => "it is not ready to move",
            _ => "the command is not valid now",
        };
        AdapterError::Rejected(format!("xarm refuses to move: {why} (state {})", self.motion.state))
    }
}
