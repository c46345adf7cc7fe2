//! What this run orders of a controller besides motion: motors, mode, stop, clearing errors. Nothing here is done
//! without an order, so what another client changes is never undone.

use std::time::Duration;

use super::connect::takes_detection;
use super::control::Purpose;
use super::mode::{ModeChange, Next};
use super::protocol::commands::{Command, STOP};
use super::session::{Ready, Session};
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_hardware::adapter::{AdapterError, AdapterResult, Stop};

/// How long one call may work on a change of mode. The next call continues it.
const MODE_SLICE: Duration = Duration::from_millis(15);
/// How long the motors may take to show in the reports (5 Hz) after the controller has answered.
const MOTORS_LIMIT: Duration = Duration::from_secs(2);
/// How long an activation may take for the mode: three steps, each answered within its timeout.
const ACTIVATION_LIMIT: Duration = Duration::from_secs(6);
/// Rounding of the load in reports [kg, mm].
const LOAD_TOLERANCE: f64 = 1e-3;
/// How long a stop waits for its confirmation: not as long as reports may be silent, after which the connection ends.
const STOP_LIMIT: Duration = Duration::from_millis(400);

impl Session {
    /// Switches all motors on or off, and waits until a report shows it.
    pub fn enable(&mut self, on: bool) -> AdapterResult<()> {
        if on {
            self.check_error()?;
        }
        (self.change, self.ready, self.foreign) = (None, None, None); // the controller forgets that it was ready
        let command = Command::Enable(on);
        let number = self.request(&command)?;
        let axes = self.device.model.axes();
        let there = move |session: &Self| match on {
            true => session.enabled(),
            false => session.condition().none_enabled(axes),
        };
        // That the motors are off shows in the reports, whether the controller answers or not.
        let answered = |session: &mut Self| {
            let answer = session.answer(number);
            Ok(answer.map(|answer| answer.status.error()).or_else(|| (!on && there(session)).then_some(false)))
        };
        let limit = command.timeout();
        let error = self.wait(limit, answered)?.ok_or_else(|| {
            let peer = self.control.peer();
            AdapterError::Timeout(format!("{peer} did not answer register 11 (motors) within {limit:?}"))
        })?;
        // An error prevents enabling, but not disabling.
        if on && error {
            self.check_error()?;
        }
        let shown = self.wait(MOTORS_LIMIT, |session| {
            if on {
                session.fault()?;
            }
            Ok(there(session).then_some(()))
        })?;
        let word = if on { "on" } else { "off" };
        shown.ok_or_else(|| AdapterError::Timeout(format!("the motors do not go {word} within {MOTORS_LIMIT:?}")))
    }

    /// Makes the arm ready for motion in a mode: warning cleared, motors on, where it is.
    pub fn activate(&mut self, mode: u8, force_torque: bool) -> AdapterResult<()> {
        self.update(Duration::ZERO)?;
        self.check_error()?;
        if self.condition().warning != 0 {
            self.ask(&Command::ClearWarning)?;
        }
        if self.moves() {
            return Err(AdapterError::Rejected("the arm is moving: another client commands it".into()));
        }
        if !self.enabled() {
            self.enable(true)?;
        }
        if force_torque {
            let status = self.ask(&Command::EnableForceTorque(true))?.status;
            self.wrench_since = (!status.error() && !status.invalid()).then(|| MonotonicClock.now());
        }
        self.control.take_refusal();
        self.foreign = None;
        self.begin_change(mode);
        if !self.finish_change(ACTIVATION_LIMIT)? {
            self.change = None;
            return Err(AdapterError::Timeout(format!("the arm is not ready within {ACTIVATION_LIMIT:?}")));
        }
        Ok(())
    }

    /// Sets the load at the flange, mass [kg] and centre [mm], and waits until a report shows it. The controller drops
    /// to mode 0: the arm must be activated again.
    pub fn set_load(&mut self, load: [f64; 4]) -> AdapterResult<()> {
        self.update(Duration::ZERO)?;
        self.check_error()?;
        if self.moves() {
            return Err(AdapterError::Rejected("the arm is moving".into()));
        }
        (self.change, self.ready, self.foreign) = (None, None, None);
        if self.ask(&Command::SetLoad(load))?.status.error() {
            self.check_error()?;
        }
        let differs = |shown: [f64; 4]| shown.iter().zip(load).any(|(a, b)| (a - b).abs() > LOAD_TOLERANCE);
        self.wait(MOTORS_LIMIT, |session| Ok((!differs(session.condition().load)).then_some(())))?;
        Ok(()) // a load that does not show is read back
    }

    /// Brings the arm into a mode. `Rejected` while it moves, and while the change is under way: ask again.
    pub fn set_mode(&mut self, mode: u8) -> AdapterResult<()> {
        self.update(Duration::ZERO)?;
        self.fault()?;
        if self.change.is_none() {
            // A change that came to nothing between two calls has stopped the arm: first why, then that.
            self.reached()?;
            let _ = self.check_refusal(); // of a setpoint; but it may tell that the arm was stopped
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
        (self.ready, self.failed) = (None, None);
    }

    /// Waits for the end of the change of mode; `false` when it is still under way after `limit`.
    fn finish_change(&mut self, limit: Duration) -> AdapterResult<bool> {
        let over = self.wait(limit, |session| Ok(session.change.is_none().then_some(())))?;
        if over.is_none() {
            return Ok(false);
        }
        self.fault()?;
        self.reached().map(|()| true)
    }

    /// Returns an error, once, if the last change did not reach its mode.
    fn reached(&mut self) -> AdapterResult<()> {
        let Some((mode, why)) = self.failed.take() else { return Ok(()) };
        Err(AdapterError::Protocol(format!("xarm did not change to mode {mode}: {why}")))
    }

    /// Continues the change of mode, as far as the newest report allows.
    pub(super) fn advance_change(&mut self) -> AdapterResult<()> {
        let Some(mut change) = self.change.take() else { return Ok(()) };
        if self.condition().error != 0 {
            return Ok(());
        }
        let now = MonotonicClock.now();
        match change.advance(&self.motion, now) {
            Next::Send(command) => {
                self.control.post(&command, Purpose::Health)?;
                self.change = Some(change);
            }
            Next::Wait => self.change = Some(change),
            Next::Done => self.ready = Some(Ready { mode: change.target, since: now }),
            Next::TakenOver => {
                self.failed = Some((change.target, "another client changed it"));
                self.ready = Some(Ready { mode: change.target, since: now });
                self.changed_by_another_client();
            }
            Next::GiveUp(why) => self.failed = Some((change.target, why)),
        }
        Ok(())
    }

    /// Whether the arm moves, by its own account.
    fn moves(&self) -> bool {
        let still = |velocity: [f64; 7]| velocity.iter().all(|v| v.abs() < 0.01);
        self.motion.state == 1 && !self.motion.velocity.is_some_and(still)
    }

    /// Stops all motion of the joints. The arm stays stopped until it is activated. Its answer confirms the stop, or a
    /// report that shows it. The gripper knows no stop: it can be held where it is.
    pub fn stop(&mut self) -> AdapterResult<Stop> {
        (self.change, self.ready, self.foreign) = (None, None, None);
        let sent = MonotonicClock.now();
        self.known.gripper.stopped(sent);
        self.request(&Command::SetState(STOP))?;
        let number = self.request(&Command::GetState)?;
        let stopped = |state: &u8| (4..=6).contains(state);
        let confirmed = self.wait(STOP_LIMIT, |session| {
            let told = session.answer(number).and_then(|answer| answer.data().first().copied()).filter(stopped);
            let shown = Some(session.motion.state).filter(stopped).filter(|_| session.measured.arrived > sent);
            Ok(told.or(shown))
        })?;
        Ok(confirmed.map_or(Stop::Sent, |_| Stop::Confirmed))
    }

    /// Clears error and warning, of the gripper too.
    pub fn clear_errors(&mut self) -> AdapterResult<()> {
        self.update(Duration::ZERO)?;
        (self.change, self.ready, self.foreign) = (None, None, None);
        self.known.gripper.clear_error();
        self.ask(&Command::ClearError)?;
        self.ask(&Command::ClearWarning)?;
        self.check_error()
    }
}
