//! A connection to a controller, from connecting to its end: what is known of the arm, kept up to date without ever
//! asking for the joints, and what can be asked of it. Units of the wire; the adapter converts.

use std::os::fd::{AsFd, BorrowedFd};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::condition::Condition;
use super::connect::takes_detection;
use super::control::{Control, Counts, Purpose, REPLY_TIMEOUT};
use super::errors::warning_text;
use super::gripper::Gripper;
use super::mode::{ModeChange, Next, is_ready};
use super::model::{Model, VELOCITY};
use super::protocol::commands::{Command, STOP};
use super::protocol::frame::{Response, Status};
use super::protocol::identity::Firmware;
use super::protocol::report::{Health, Motion};
use super::stream::Stream;
use crate::clock::{Clock, Mono, MonotonicClock};
use crate::hardware::spec::{AdapterError, AdapterResult, Stop};
use crate::hardware::transport::device_time::DeviceTime;
use crate::joint::JointLimits;

/// A controller that lives reports 100 or 250 times a second: after so much silence, also on a connection that
/// looks well, it is gone.
pub const SILENCE: Duration = Duration::from_millis(500);
/// Reports from before an answer may still be on the way for so long after it: two periods of the slower kind.
const ON_THE_WAY: Duration = Duration::from_millis(20);
/// Which motors are on is told five times a second, and by nothing else: after so much silence that is not known.
const CONDITION_SILENCE: Duration = Duration::from_millis(1000);
/// How long one call may work on a change of mode. It goes on with the next call.
const MODE_SLICE: Duration = Duration::from_millis(15);
/// How long an activation may take for the motors, and for the mode.
const MOTORS_LIMIT: Duration = Duration::from_millis(900);
const ACTIVATION_LIMIT: Duration = Duration::from_millis(1200);
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
struct Known {
    condition: Condition,
    gripper: Gripper,
}

impl Known {
    fn take(&mut self, purpose: Purpose, response: &Response) {
        self.condition.hint(response.status);
        match purpose {
            Purpose::Health => self.condition.take(response),
            Purpose::Gripper => self.gripper.take(response),
            Purpose::Motion | Purpose::Answer => {}
        }
    }
}

/// A connected arm.
pub struct Session {
    /// What it is.
    pub device: Device,
    control: Control,
    reports: Stream<Motion>,
    normal: Stream<Health>,
    known: Known,
    motion: Motion,
    /// When the newest positions were measured, and when they came.
    stamp: Mono,
    fresh_at: Mono,
    device_time: DeviceTime,
    suspect: bool,
    /// The arm has stopped, by us or by somebody else: only an activation makes it ready again.
    halted: bool,
    /// A change of mode under way: it goes on with every report, whoever asks.
    change: Option<ModeChange>,
    /// The mode that the last change did not reach, and why, until somebody hears of it.
    failed: Option<(u8, &'static str)>,
    /// When the force/torque sensor was switched on: before that its place in the reports holds zeros.
    wrench_since: Option<Mono>,
    updated: Mono,
}

impl Session {
    /// Begins with a first report. The arm counts as stopped until it is activated.
    pub fn new(
        device: Device,
        control: Control,
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
            reports,
            normal,
            known: Known { condition, gripper },
            motion: first,
            stamp,
            fresh_at: arrived,
            device_time,
            suspect: false,
            halted: true,
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

    /// Takes up all that has arrived, without waiting, and asks what is due. Does nothing within `age` of the last time.
    pub fn update(&mut self, age: Duration) -> AdapterResult<()> {
        let now = MonotonicClock.now();
        if now.since(self.updated) < age {
            return Ok(());
        }
        self.updated = now;
        if let Some(motion) = self.reports.newest()? {
            self.take(motion);
        }
        if let Some(health) = self.normal.newest()? {
            self.known.condition.report(health);
        }
        while let Some((purpose, response)) = self.control.next()? {
            self.known.take(purpose, &response);
        }
        if MonotonicClock.now().since(self.fresh_at) > SILENCE {
            return Err(AdapterError::Io(format!("{} sent nothing new for {SILENCE:?}", self.reports.peer())));
        }
        if MonotonicClock.now().since(self.normal.arrived) > CONDITION_SILENCE {
            return Err(AdapterError::Io(format!("{} sent nothing for {CONDITION_SILENCE:?}", self.normal.peer())));
        }
        self.advance_change()?;
        if let Some(question) = self.known.condition.due(now, self.control.last_sent()) {
            self.control.post(&question, Purpose::Health)?;
        }
        if let Some(telegram) = self.known.gripper.due(now) {
            self.control.post(&Command::Tool(telegram), Purpose::Gripper)?;
        }
        Ok(())
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
        if !is_ready(motion.state) && self.change.is_none() && !self.halted {
            self.halted = true;
            self.known.condition.changed = true;
        }
        self.motion = motion;
    }

    /// Waits for the next report, a few ms at most.
    fn pause(&self) {
        let timeout = Timespec { tv_sec: 0, tv_nsec: 5_000_000 };
        let _ = poll(&mut [PollFd::from_borrowed_fd(self.fd(), PollFlags::IN)], Some(&timeout));
    }

    /// Asks and waits for the answer.
    fn ask(&mut self, command: &Command) -> AdapterResult<Response> {
        let known = &mut self.known;
        let response = self.control.ask(command, REPLY_TIMEOUT, |purpose, response| known.take(purpose, response))?;
        self.known.condition.hint(response.status);
        Ok(response)
    }

    /// Asks for the error, and answers it as such when there is one.
    pub fn check_error(&mut self) -> AdapterResult<()> {
        let answer = self.ask(&Command::GetError)?;
        self.known.condition.take(&answer);
        self.fault()
    }

    /// The known error, as such.
    fn fault(&self) -> AdapterResult<()> {
        match self.known.condition.error {
            0 => Ok(()),
            code => Err(AdapterError::Fault { code: code.into(), text: self.known.condition.text() }),
        }
    }

    // --- Motors, mode, stop ---

    /// Switches all motors on or off, and sees it.
    pub fn enable(&mut self, on: bool) -> AdapterResult<()> {
        if on {
            self.check_error()?;
        }
        self.change = None;
        self.halted = true; // the controller forgets that it was ready
        let answer = self.ask(&Command::Enable(on))?;
        // An error stands against enabling; that the motors go off shows in the reports, error or not.
        if on && answer.status.error() {
            self.check_error()?;
        }
        let until = MonotonicClock.now().after(MOTORS_LIMIT);
        let axes = self.device.model.axes();
        let none = |condition: &Condition| (0..axes).all(|i| condition.enabled & (1 << i) == 0);
        while if on { !self.enabled() } else { !none(&self.known.condition) } {
            if MonotonicClock.now() >= until {
                let word = if on { "on" } else { "off" };
                return Err(AdapterError::Timeout(format!("the motors do not go {word} within {MOTORS_LIMIT:?}")));
            }
            self.pause();
            self.update(Duration::ZERO)?;
            if on {
                self.fault()?;
            }
        }
        Ok(())
    }

    /// Makes the arm ready for motion in a mode: warning cleared, motors on, where it is.
    pub fn activate(&mut self, mode: u8, force_torque: bool) -> AdapterResult<()> {
        self.update(Duration::ZERO)?;
        self.check_error()?;
        if self.known.condition.warning != 0 {
            self.ask(&Command::ClearWarning)?;
        }
        if self.moves() {
            return Err(AdapterError::Rejected("the arm is moving: somebody else commands it".into()));
        }
        if !self.enabled() {
            self.enable(true)?;
        }
        if force_torque {
            let status = self.ask(&Command::EnableForceTorque(true))?.status;
            self.wrench_since = (!status.error() && !status.invalid()).then(|| MonotonicClock.now());
        }
        self.control.take_refusal();
        self.begin_change(mode);
        if !self.finish_change(ACTIVATION_LIMIT)? {
            self.change = None;
            return Err(AdapterError::Timeout(format!("the arm is not ready within {ACTIVATION_LIMIT:?}")));
        }
        self.halted = false;
        Ok(())
    }

    /// Brings the arm into a mode. `Rejected` while it moves, and while the change is under way: ask again.
    pub fn set_mode(&mut self, mode: u8) -> AdapterResult<()> {
        self.update(Duration::ZERO)?;
        self.fault()?;
        if self.change.is_none() {
            // A change that came to nothing between two calls has stopped the arm: first why, then that.
            self.reached()?;
            let _ = self.heed_refusal(); // of a set point; but it may tell that the arm was stopped
            self.may_be_commanded()?;
        }
        if self.change.is_none_or(|change| change.target != mode) {
            if self.moves() {
                return Err(AdapterError::Rejected("the arm is moving".into()));
            }
            self.begin_change(mode);
        }
        match self.finish_change(MODE_SLICE)? {
            true => Ok(()),
            false => Err(AdapterError::Rejected("the change of mode is under way".into())),
        }
    }

    fn begin_change(&mut self, mode: u8) {
        let detect = takes_detection(self.device.firmware);
        self.change = Some(ModeChange::new(mode, detect, MonotonicClock.now()));
        self.failed = None;
    }

    /// Waits for the end of the change of mode; `false` when it is still under way after `limit`.
    fn finish_change(&mut self, limit: Duration) -> AdapterResult<bool> {
        let until = MonotonicClock.now().after(limit);
        self.update(Duration::ZERO)?;
        while self.change.is_some() {
            if MonotonicClock.now() >= until {
                return Ok(false);
            }
            self.pause();
            self.update(Duration::ZERO)?;
        }
        self.fault()?;
        self.reached().map(|()| true)
    }

    /// An error, told once, when the last change did not reach its mode.
    fn reached(&mut self) -> AdapterResult<()> {
        let Some((mode, why)) = self.failed.take() else { return Ok(()) };
        Err(AdapterError::Protocol(format!("xarm did not change to mode {mode}: {why}")))
    }

    /// Goes on with the change of mode, as far as the newest report allows.
    fn advance_change(&mut self) -> AdapterResult<()> {
        let Some(mut change) = self.change.take() else { return Ok(()) };
        if self.known.condition.error != 0 {
            self.halted = true;
            return Ok(());
        }
        let next = change.advance(&self.motion, MonotonicClock.now());
        match next {
            Next::Send(command) => {
                self.control.post(&command, Purpose::Health)?;
                self.change = Some(change);
            }
            Next::Wait => self.change = Some(change),
            Next::Done => {}
            Next::GiveUp(why) => (self.failed, self.halted) = (Some((change.target, why)), true),
        }
        Ok(())
    }

    /// Whether the arm moves, by its own account.
    fn moves(&self) -> bool {
        let still = |velocity: [f64; 7]| velocity.iter().all(|v| v.abs() < 0.01);
        self.motion.state == 1 && !self.motion.velocity.is_some_and(still)
    }

    /// Stops all motion of the joints. The arm stays stopped until it is activated. The gripper knows no stop: it can be
    /// held where it is.
    pub fn stop(&mut self) -> AdapterResult<Stop> {
        (self.change, self.halted) = (None, true);
        self.known.gripper.stopped(MonotonicClock.now());
        self.ask(&Command::SetState(STOP))?;
        let state = self.ask(&Command::GetState)?.data().first().copied();
        Ok(if matches!(state, Some(4..=6)) { Stop::Confirmed } else { Stop::Sent })
    }

    /// Clears error and warning, of the gripper too.
    pub fn clear_errors(&mut self) -> AdapterResult<()> {
        self.update(Duration::ZERO)?;
        (self.change, self.halted) = (None, true);
        self.known.gripper.clear_error();
        self.ask(&Command::ClearError)?;
        self.ask(&Command::ClearWarning)?;
        self.check_error()
    }

    // --- Motion ---

    fn may_be_commanded(&self) -> AdapterResult<()> {
        if !self.enabled() {
            Err(AdapterError::Rejected("the motors are disabled".into()))
        } else if self.halted || !is_ready(self.motion.state) {
            Err(AdapterError::Rejected("the arm was stopped: enable it again".into()))
        } else {
            Ok(())
        }
    }

    fn may_move(&mut self, mode: u8) -> AdapterResult<()> {
        self.fault()?;
        self.may_be_commanded()?;
        if self.motion.mode != mode || self.change.is_some() {
            return Err(AdapterError::Rejected(format!("the arm is in mode {}, not {mode}", self.motion.mode)));
        }
        Ok(())
    }

    /// Sends a command of a stream (a set point, velocities) and does not wait for its response. When an earlier one
    /// was refused, that is the answer.
    pub fn stream(&mut self, mode: u8, command: &Command) -> AdapterResult<()> {
        self.may_move(mode)?;
        self.control.post(command, Purpose::Motion)?;
        self.heed_refusal()
    }

    /// Tells of a set point that was refused. An arm that is not ready was stopped by somebody: the response may say so
    /// before the report does.
    fn heed_refusal(&mut self) -> AdapterResult<()> {
        let Some(status) = self.control.take_refusal() else { return Ok(()) };
        self.halted |= status.not_ready();
        self.known.condition.changed |= status.not_ready();
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
        self.halted |= status.not_ready();
        if status.not_ready() || status.invalid() { Err(self.refused(status)) } else { Ok(()) }
    }

    fn refused(&self, status: Status) -> AdapterError {
        if let Err(fault) = self.fault() {
            return fault;
        }
        let why = match status {
            status if status.error() => "it is in error",
            status if status.not_ready() => "it is not ready to move",
            _ => "the command is not valid now",
        };
        AdapterError::Rejected(format!("xarm refuses to move: {why} (state {})", self.motion.state))
    }
}
