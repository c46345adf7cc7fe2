//! Commands of the tick on their way to the arm: setpoints, stops, gripper commands, and what happens when the arm does
//! not take them.

use std::sync::atomic::Ordering::{Relaxed, Release};
use std::time::Duration;

use super::Worker;
use super::tick_monitor::MAX_DELAY;
use crate::adapter::{AdapterError, AdapterResult, ManipulatorAdapter, Stop};
use dimos_core::arm::{ArmCommand, Interference, Setpoint, StopPoint};
use dimos_core::joint::ControlMode;

/// Unacknowledged setpoints before the connection is dropped.
pub(super) const MAX_IN_FLIGHT: u32 = 2;
/// How long an arm may refuse a change of mode because it still moves.
const MODE_TIMEOUT: Duration = Duration::from_secs(1);

impl Worker {
    /// Takes the newest command and returns the previous one.
    pub(super) fn take_command(&mut self) -> ArmCommand {
        let command = self.commands.read();
        if command.stop_seq != self.last.stop_seq {
            self.stop_pending = true;
            self.stop_peripherals();
        }
        if self.last.led && !command.led {
            self.lead.end("the arm was stopped");
        }
        std::mem::replace(&mut self.last, command)
    }

    /// Takes the newest command while disconnected: keeps a stop for later, refuses a gripper command.
    pub(super) fn skip_command(&mut self) {
        let before = self.take_command();
        if self.last.gripper_seq != before.gripper_seq {
            self.health.answer_gripper(self.last.gripper_seq, Err(AdapterError::NotConnected));
        }
    }

    /// Returns whether commands of the tick currently move the arm.
    pub(super) fn moving(&self) -> bool {
        self.connected && (self.last.mode.is_some() || self.lead.active) && !self.state.self_held
    }

    pub(super) fn send_command(&mut self, adapter: &mut dyn ManipulatorAdapter) {
        let before = self.take_command();
        let command = self.last;
        if command.seq == before.seq && !self.resend {
            return;
        }
        self.resend = false;
        // A polled device is read just before the tick; one that streams its state sets its own pace.
        if adapter.state_fd().is_none() {
            self.read_before(command.next_tick);
        }
        if command.gripper_seq != before.gripper_seq {
            self.move_gripper(adapter, &command);
        }
        if self.state.self_held || !self.connected {
            return;
        }
        match self.write(adapter, &command) {
            Ok(()) if self.stop_pending => {}
            Ok(()) => self.write_errors = 0,
            // Not sent, but not a failure: the tick sees that it was not written.
            Err(AdapterError::Busy) => self.resend = true,
            // The arm can be reached: the tick stops it.
            Err(error @ AdapterError::Rejected(_)) => {
                self.state.refused = command.seq;
                self.health.write_errors.fetch_add(1, Relaxed);
                self.trouble(&format!("a setpoint was refused: {error}"));
            }
            Err(error) => {
                if matches!(error, AdapterError::Timeout(_)) {
                    self.in_flight += 1;
                }
                self.write_failed(adapter, "a command was not taken", &error);
            }
        }
        // Published at once: the next tick continues from what was written.
        self.states.write(&self.state);
    }

    pub(super) fn write(&mut self, adapter: &mut dyn ManipulatorAdapter, command: &ArmCommand) -> AdapterResult<()> {
        let Some(mode) = command.mode else {
            self.mode_refused_since = None;
            return Ok(());
        };
        // Another client changed the mode: do not change it back. The next state reports it.
        let foreign = self.ordered_mode == Some(mode) && adapter.get_control_mode() != mode;
        // An arm that has lost its gripper decelerates as any other.
        if foreign || !matches!(self.state.interference, Interference::None | Interference::Tool) {
            return Ok(());
        }
        if adapter.get_control_mode() != mode {
            self.ordered_mode = None;
            match adapter.set_control_mode(mode) {
                // The arm may count as moving for slightly longer than it does here. The tick waits for the mode, and
                // the next command retries.
                Err(AdapterError::Rejected(_)) if !self.mode_overdue() => return Ok(()),
                result => result?,
            }
        }
        self.mode_refused_since = None;
        self.ordered_mode = Some(mode);
        let age = self.config.clock.now().since(self.state.stamp);
        if !self.guard.admits(command, mode, &self.state, age, self.config.read_period()) {
            self.health.withheld.fetch_add(1, Relaxed);
            if self.guard.continues(command, mode) {
                self.state.refused = command.seq;
            }
            return Ok(());
        }
        let written = match mode {
            ControlMode::Velocity => {
                adapter.write_joint_velocities(command.values.get(..self.config.dof).unwrap_or_default())
            }
            _ => self.write_setpoint(adapter, command, mode),
        };
        // A setpoint without an acknowledgement may have reached the arm: the next one continues from it.
        if matches!(written, Ok(()) | Err(AdapterError::Timeout(_))) {
            self.guard.wrote(command, mode);
            self.state.written = command.seq;
        }
        written?;
        self.in_flight = 0;
        self.health.writes.fetch_add(1, Relaxed);
        Ok(())
    }

    /// Writes a setpoint; an arm that answers it with its state is not asked for that.
    fn write_setpoint(
        &mut self,
        adapter: &mut dyn ManipulatorAdapter,
        command: &ArmCommand,
        mode: ControlMode,
    ) -> AdapterResult<()> {
        let [stiffness, damping] = command.gains.map_or([None, None], |gains| gains.map(Some));
        let setpoint = Setpoint {
            position: command.values,
            velocity: command.velocity,
            acceleration: Some(command.acceleration),
            effort: command.effort,
            stiffness,
            damping,
            mode,
            at: command.at,
            expires: Some(command.at.after(self.guard.longest_gap())),
        };
        if !adapter.exchanges() {
            return adapter.write_setpoint(&setpoint);
        }
        let exchanged = adapter.exchange(Some(&setpoint), &mut self.reading);
        self.exchanged = exchanged.is_ok();
        exchanged
    }

    /// Returns whether the arm has refused a change of mode for longer than [`MODE_TIMEOUT`].
    pub(super) fn mode_overdue(&mut self) -> bool {
        let now = self.config.clock.now();
        now.since(*self.mode_refused_since.get_or_insert(now)) > MODE_TIMEOUT
    }

    /// Returns where the arm is to rest: where braking from the newest command ends that had a mode; after silence,
    /// where the arm is within what was commanded meanwhile.
    pub(super) fn stop_point(&self) -> StopPoint {
        let heard = self.config.clock.now().since(self.state.stamp) <= self.config.state_timeout();
        let (dof, supervision) = (self.config.dof, &self.config.supervision);
        let within = self.last.rest_within_unheard(&self.state.position, dof, supervision).filter(|_| heard);
        StopPoint { position: within.or(self.last.rest) }
    }

    /// Sends the arm's own stop; retried in every cycle until the arm takes it.
    pub(super) fn stop(&mut self, adapter: &mut dyn ManipulatorAdapter) {
        if !self.stop_pending || !self.connected {
            return;
        }
        if self.last.unheard.is_some() && self.config.clock.now().since(self.state.stamp) > self.config.state_timeout()
        {
            self.read(adapter);
            if !self.connected {
                return;
            }
        }
        let power = self.ordered_power;
        match adapter.write_stop(&self.stop_point()) {
            Ok(stop) => {
                self.stop_pending = false;
                self.lead.end("the arm was stopped");
                let interference = self.state.interference;
                self.expect_nothing(power);
                self.state.interference = interference;
                self.gripper_stop.begin(self.config.clock.now());
                if stop == Stop::Confirmed {
                    self.health.stop_confirmed.store(self.last.stop_seq, Relaxed);
                }
                // Stored last, so that readers of this value also see the confirmation.
                self.health.stop_sent.store(self.last.stop_seq, Release);
                self.health.answered();
            }
            Err(error) => self.write_failed(adapter, "the arm did not take the stop", &error),
        }
    }

    /// Commands the gripper and answers the request. A refusal does not affect the joints.
    pub(super) fn move_gripper(&mut self, adapter: &mut dyn ManipulatorAdapter, command: &ArmCommand) {
        if !self.state.self_held
            && let Some(gripper) = &mut self.config.peripherals.gripper
        {
            return gripper.command(command); // its thread answers
        }
        let result = if self.state.self_held {
            Err(AdapterError::Rejected("the arm is held; `arm enable` makes it ready again".to_owned()))
        } else {
            self.gripper_stop.end();
            let (position, force) = (command.gripper, command.gripper_force);
            let gripper = adapter.gripper().ok_or(AdapterError::Unsupported);
            gripper.and_then(|gripper| gripper.command(position, force, command.gripper_speed))
        };
        if result.is_ok() {
            self.gripper_stop.commanded(command.gripper_force);
        }
        match &result {
            Ok(()) => {}
            Err(error @ (AdapterError::Rejected(_) | AdapterError::Unsupported | AdapterError::Fault { .. })) => {
                self.health.write_errors.fetch_add(1, Relaxed);
                self.trouble(&format!("the gripper refused its command: {error}"));
            }
            Err(error) => {
                if matches!(error, AdapterError::Timeout(_)) {
                    self.in_flight += 1;
                }
                self.write_failed(adapter, "the gripper command failed", error);
            }
        }
        self.health.answer_gripper(command.gripper_seq, result);
    }

    /// Holds a gripper that continues to move after a stop of the joints, with the force of its last command.
    pub(super) fn hold_gripper(&mut self, adapter: &mut dyn ManipulatorAdapter) {
        let now = self.config.clock.now();
        let own = adapter.gripper().filter(|_| self.config.peripherals.gripper.is_none());
        let (Some(position), Some(gripper)) = (self.state.gripper, own) else { return };
        let Some(here) = self.gripper_stop.observe(position, gripper.get_gripper_unit(), now) else { return };
        // Closed may be the larger position of a rotary jaw.
        let (a, b) = gripper.get_gripper_range().unwrap_or((f64::MIN, f64::MAX));
        if let Err(error) = gripper.command(here.max(a.min(b)).min(a.max(b)), self.gripper_stop.force(), None) {
            self.trouble(&format!("the gripper cannot be held: {error}"));
        }
    }

    /// Discards setpoints in flight when the arm's state is stale: unacknowledged setpoints must not reach the arm
    /// later. While this thread was not run it could not see that the state is fresh.
    pub(super) fn discard_if_stale(&mut self, adapter: &mut dyn ManipulatorAdapter) {
        let own = if self.late < MAX_DELAY { self.late } else { Duration::ZERO };
        let age = self.config.clock.now().since(self.state.stamp.max(self.last_read)).saturating_sub(own);
        let stale = age > self.config.state_timeout() && self.state.seq != 0;
        if self.connected && (self.in_flight > 0 || self.resend) && stale {
            self.trouble("setpoints are not acknowledged and no state arrives: pending setpoints discarded");
            self.discard(adapter);
        }
    }

    pub(super) fn discard(&mut self, adapter: &mut dyn ManipulatorAdapter) {
        (self.in_flight, self.resend) = (0, false);
        self.state.self_held = true;
        adapter.discard_pending();
        if !adapter.is_connected() {
            self.mark_lost();
        }
        self.states.write(&self.state);
    }

    pub(super) fn write_failed(&mut self, adapter: &mut dyn ManipulatorAdapter, what: &str, error: &AdapterError) {
        self.health.write_errors.fetch_add(1, Relaxed);
        self.write_errors += 1;
        // Commands and stops fail together: log the first failure, count the others.
        if self.write_errors == 1 {
            self.first_write_failure = format!("{what}: {error}");
        }
        let text = self.first_write_failure.clone();
        self.trouble(&text);
        self.after_error(adapter, error);
    }
}
