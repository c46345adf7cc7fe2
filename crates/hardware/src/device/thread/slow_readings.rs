//! Optional parts of the arm: the stop input, which is read in every cycle, and values that change slowly, of which one
//! is read a few times a second.

use std::time::Duration;

use super::{Worker, payload};
use crate::adapter::{AdapterError, AdapterResult, ManipulatorAdapter};
use crate::device::{Details, Note};
use dimos_core::arm::{IoState, JointStatus, Load, OutputValue};
use dimos_core::clock::Mono;
use dimos_core::joint::{Joints, MAX_DOF};

/// Time between two slow readings. On some arms each costs a round trip.
const PERIOD: Duration = Duration::from_millis(200);

/// What is read in turn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Turn {
    Io,
    Joints,
    Payload,
}

const TURNS: [Turn; 3] = [Turn::Io, Turn::Joints, Turn::Payload];

/// The slow readings of a device thread.
#[derive(Debug, Default)]
pub(super) struct Slow {
    details: Details,
    /// A reader held the published values: publish them with the next cycle.
    unpublished: bool,
    due: Mono,
    turn: usize,
    /// Which readings failed the last time; the first failure of each was logged.
    failing: [bool; TURNS.len()],
}

impl Slow {
    /// Takes the load that the controller reports.
    pub(super) fn take_payload(&mut self, load: Option<Load>, now: Mono) {
        let details = &mut self.details;
        if details.payload != load {
            (details.payload, details.payload_stamp) = (load, now);
            details.payload_seq += 1;
            self.unpublished = true;
        }
    }

    /// Makes inputs and outputs the next slow reading, with the next cycle: one of them was set.
    pub(super) fn read_io_next(&mut self) {
        (self.due, self.turn) = (Mono::ZERO, 0);
    }

    fn take_io(&mut self, io: Option<IoState>, now: Mono) {
        let details = &mut self.details;
        details.io_stamp = now;
        if details.io != io {
            (details.io, details.io_seq) = (io, details.io_seq + 1);
            self.unpublished = true;
        }
    }
}

impl Worker {
    /// Returns an error if the arm lacks a part that the blueprint uses.
    pub(super) fn check_parts(&self, adapter: &mut dyn ManipulatorAdapter) -> AdapterResult<()> {
        self.check_peripherals(adapter)?;
        let setup = &self.config.setup;
        if adapter.payload().is_none() && (setup.payload.is_some() || setup.gravity.is_some()) {
            let what =
                "the arm's controller takes neither a payload nor a mounting\nhint: remove `payload` and `mounting`";
            return Err(AdapterError::Rejected(what.to_owned()));
        }
        let Some(stop) = setup.stop_input else { return Ok(()) };
        match adapter.io().map_or(0, |io| io.get_io().digital_inputs) {
            inputs if stop.input < inputs => Ok(()),
            0 => Err(AdapterError::Rejected(format!(
                "stop_input: the arm has no digital inputs, so di{} cannot stop it\nhint: remove `stop_input`",
                stop.input
            ))),
            inputs => Err(AdapterError::Rejected(format!(
                "stop_input: the arm has no digital input di{}\nhint: it has di0 to di{}",
                stop.input,
                inputs - 1
            ))),
        }
    }

    /// Reads the inputs, if one of them stops the arm or is awaited. An error counts as no state: the arm is held.
    pub(super) fn read_inputs(&mut self, adapter: &mut dyn ManipulatorAdapter) -> AdapterResult<()> {
        let stop = self.config.setup.stop_input;
        if stop.is_none() && !self.watches_inputs {
            return Ok(());
        }
        let io = read_io(adapter)?;
        self.state.stop_input_open = stop.is_some_and(|stop| stop.is_open(&io));
        self.state.inputs = Some(io.digital_inputs).filter(|_| self.watches_inputs);
        self.slow.take_io(Some(io), self.config.clock.now());
        Ok(())
    }

    /// Makes a slow reading, if it is due. An error of the reading alone does not affect the arm.
    pub(super) fn read_slowly(&mut self, adapter: &mut dyn ManipulatorAdapter) -> AdapterResult<()> {
        let now = self.config.clock.now();
        if now >= self.slow.due {
            self.slow.due = now.after(PERIOD);
            let index = self.slow.turn % TURNS.len();
            self.slow.turn = index + 1;
            let result = TURNS.get(index).map_or(Ok(()), |turn| self.slow_turn(adapter, *turn, now));
            // A lost connection is a failed read.
            let lost = matches!(result, Err(AdapterError::NotConnected)) || !adapter.is_connected();
            self.log_slow_failure(index, &result);
            if lost {
                return result;
            }
        }
        self.publish_slow();
        Ok(())
    }

    /// Publishes changed values; retried in the next cycle while a reader holds them.
    pub(super) fn publish_slow(&mut self) {
        if self.slow.unpublished {
            self.slow.unpublished = !self.health.publish_details(&self.slow.details);
        }
    }

    fn slow_turn(&mut self, adapter: &mut dyn ManipulatorAdapter, turn: Turn, now: Mono) -> AdapterResult<()> {
        match turn {
            // The stop input is read in every cycle, with all others.
            Turn::Io if self.config.setup.stop_input.is_some() => Ok(()),
            Turn::Io => {
                let io = optional(read_io(adapter));
                self.slow.take_io(io.clone().ok().flatten(), now);
                io.map(drop)
            }
            Turn::Joints => {
                let mut joints = [JointStatus::default(); MAX_DOF];
                let all = joints.get_mut(..self.config.dof).unwrap_or_default();
                let monitor = adapter.joint_monitor().ok_or(AdapterError::Unsupported);
                let read = optional(monitor.and_then(|monitor| monitor.read_joint_status(all)));
                let details = &mut self.slow.details;
                if let Ok(Some(())) = read {
                    (details.joints, details.joints_stamp) = (Some(joints), now);
                    details.joints_seq += 1;
                    self.slow.unpublished = true;
                } else if details.joints.take().is_some() {
                    self.slow.unpublished = true;
                }
                read.map(drop)
            }
            Turn::Payload => {
                let load = optional(payload::read(adapter));
                // A controller that reports none has what was set.
                let known = load.clone().ok().flatten().map(|reported| reported.or(self.payload));
                self.slow.take_payload(known.flatten(), now);
                load.map(drop)
            }
        }
    }

    /// Logs the first of consecutive failures. They are no trouble of the arm: its state comes.
    fn log_slow_failure<T>(&mut self, index: usize, result: &AdapterResult<T>) {
        let Some(failing) = self.slow.failing.get_mut(index) else { return };
        let began = !std::mem::replace(failing, result.is_err());
        if let Err(error) = result
            && began
        {
            (self.config.notes)(Note::Began(format!("status values cannot be read: {error}")));
        }
    }
}

/// Returns a reading of an optional part; `None` if the arm lacks it.
fn optional<T>(result: AdapterResult<T>) -> AdapterResult<Option<T>> {
    match result {
        Err(AdapterError::Unsupported) => Ok(None),
        result => result.map(Some),
    }
}

/// Reads the calibration offsets [rad]; `None` if the device does not report them.
pub(super) fn calibration_offsets(adapter: &mut dyn ManipulatorAdapter, dof: usize) -> AdapterResult<Option<Joints>> {
    let Some(monitor) = adapter.joint_monitor() else { return Ok(None) };
    let mut offsets = [0.0; MAX_DOF];
    let known = monitor.read_calibration_offsets(offsets.get_mut(..dof).unwrap_or_default())?;
    Ok(known.then_some(offsets))
}

/// Reads the levels of all inputs and outputs.
pub(super) fn read_io(adapter: &mut dyn ManipulatorAdapter) -> AdapterResult<IoState> {
    let mut state = IoState::default();
    adapter.io().ok_or(AdapterError::Unsupported)?.read_io(&mut state)?;
    Ok(state)
}

/// Sets an output.
pub(super) fn set_output(adapter: &mut dyn ManipulatorAdapter, value: OutputValue) -> AdapterResult<()> {
    let io = adapter.io().ok_or(AdapterError::Unsupported)?;
    let info = io.get_io();
    let missing = |kind: &str, index: u8, number: usize| {
        let has = match number {
            0 => "it has none".to_owned(),
            number => format!("it has {kind}0 to {kind}{}", number - 1),
        };
        Err(AdapterError::Rejected(format!("the arm has no output {kind}{index}\nhint: {has}")))
    };
    match value {
        OutputValue::Digital(index, _) if index >= info.digital_outputs => {
            missing("do", index, info.digital_outputs.into())
        }
        OutputValue::Analog(index, _) if usize::from(index) >= info.analog_outputs.len() => {
            missing("ao", index, info.analog_outputs.len())
        }
        OutputValue::Analog(_, value) if !value.is_finite() => {
            Err(AdapterError::Rejected(format!("{value} is not a finite number")))
        }
        OutputValue::Digital(index, high) => io.write_digital_output(index, high),
        OutputValue::Analog(index, value) => io.write_analog_output(index, value),
    }
}
