//! Motion commands of a session: streamed setpoints and planned moves, and what the controller refuses.

use super::control::Purpose;
use super::errors::warning_text;
use super::mode::is_ready;
use super::protocol::commands::Command;
use super::protocol::frame::Status;
use super::session::Session;
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_hardware::adapter::{AdapterError, AdapterResult};

impl Session {
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

    /// Sends a streamed command (positions or velocities) without waiting for its response. Refuses it when the newest
    /// report or response shows that the arm is not in the ordered state, and with `Busy` while two are unanswered.
    pub fn stream(&mut self, mode: u8, command: &Command) -> AdapterResult<()> {
        self.receive()?;
        self.check_refusal()?;
        self.may_move(mode)?;
        if self.refused_at.is_some_and(|refused| self.measured.arrived <= refused) {
            return Err(AdapterError::Busy);
        }
        self.control.post(command, Purpose::Motion)?;
        self.streamed_at = self.control.last_sent();
        Ok(())
    }

    /// Returns an error if the controller refused a setpoint. Its response may show that the arm is not ready before
    /// the report does.
    pub(super) fn check_refusal(&mut self) -> AdapterResult<()> {
        let Some((status, sent)) = self.control.take_refusal() else { return Ok(()) };
        if self.ready.is_none_or(|ready| sent < ready.since) && self.foreign.is_none() {
            return Ok(()); // a setpoint from before a stop or a change of mode of this run
        }
        self.refused_at = Some(MonotonicClock.now());
        Err(self.refused(status))
    }

    /// Checks whether a planned move would be sent.
    pub fn may_plan(&mut self) -> AdapterResult<()> {
        self.may_move(0)
    }

    /// Sends a move that the controller plans, and waits for its response.
    pub fn plan(&mut self, command: &Command) -> AdapterResult<()> {
        self.may_move(0)?;
        let status = self.ask(&self.within_reduced(*command))?.status;
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
