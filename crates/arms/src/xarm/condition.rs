//! Condition of the controller: error, warning, motors. Only register 15 says what the error is. Anything that hints at
//! a change (the state byte of a response, a report, a stop that this run did not order) triggers a request for it.

use std::time::Duration;

use super::errors::{error_text, servo_text};
use super::protocol::commands::Command;
use super::protocol::frame::{Response, Status};
use super::protocol::reduced::Reduced;
use super::protocol::report::{Health, Motors};
use dimos_core::clock::Mono;

/// Maximum time between two requests, which also shows that the controller still answers.
const HEARTBEAT: Duration = Duration::from_millis(250);
/// Unanswered requests are retried after this time.
const RETRY_AFTER: Duration = Duration::from_millis(200);
/// Errors of the joints' servos, with details in another register.
const SERVO_ERRORS: std::ops::RangeInclusive<u8> = 10..=17;
/// Errors that mean an open E-stop line: the motors have no power.
const POWER_CUT: std::ops::RangeInclusive<u8> = 1..=3;

/// Condition of the controller.
#[derive(Debug, Clone, Copy, Default)]
pub struct Condition {
    /// The error; 0 = none.
    pub error: u8,
    /// The warning; 0 = none.
    pub warning: u8,
    /// Motors that are on, one bit per joint.
    pub enabled: u8,
    /// Offset of the tool from the flange: x, y, z [mm], roll, pitch, yaw [rad]; `None` before the first report.
    pub tool: Option<[f64; 6]>,
    /// Pose of the base in the reference frame of poses, alike, if reported.
    pub base: Option<[f64; 6]>,
    /// Load at the flange: mass [kg], centre x, y, z [mm].
    pub load: [f64; 4],
    /// Direction of gravity in the base frame, if reported.
    pub gravity: Option<[f64; 3]>,
    /// Condition of the joints' motors, if reported.
    pub motors: Option<Motors>,
    /// Error codes of the joints' servos.
    pub servos: [u8; 7],
    /// The settings of reduced mode; `None`: not known.
    pub reduced: Option<Reduced>,
    /// Reports do not have them: register 53 is read instead, in turn with register 15 when nothing else is sent.
    asks_reduced: bool,
    asked_reduced: bool,
    /// Whether something has changed, so that register 15 must be read.
    pub changed: bool,
    /// When a change was seen that only a later request explains.
    doubted: Mono,
    servos_changed: bool,
    /// Time of the outstanding request.
    asked: Option<Mono>,
}

impl Condition {
    /// Returns whether the motors of the first `axes` joints are on.
    pub fn all_enabled(&self, axes: usize) -> bool {
        let all = ((1_u16 << axes) - 1) as u8;
        self.enabled & all == all
    }

    /// Returns whether the motors of the first `axes` joints are off.
    pub fn none_enabled(&self, axes: usize) -> bool {
        u16::from(self.enabled) & ((1 << axes) - 1) == 0
    }

    /// Checks the state byte of a response.
    pub fn hint(&mut self, status: Status) {
        self.changed |= status.error() != (self.error != 0);
    }

    /// Checks a report.
    pub fn report(&mut self, health: Health) {
        (self.enabled, self.tool, self.base) = (health.enabled, Some(health.tool), health.base);
        (self.load, self.gravity, self.motors) = (health.load, health.gravity, health.motors);
        self.reduced = health.reduced.or(self.reduced);
        self.changed |= health.error != self.error || health.warning != self.warning;
    }

    /// Records a change at `now`, which earlier requests do not explain.
    pub fn doubt(&mut self, now: Mono) {
        (self.changed, self.doubted) = (true, now);
    }

    /// Takes the response to a request of [`Condition::due`].
    pub fn take(&mut self, response: &Response) {
        match (response.register, response.data()) {
            (15, [error, warning, ..]) => {
                self.servos_changed = SERVO_ERRORS.contains(error) && *error != self.error;
                (self.error, self.warning) = (*error, *warning);
                self.changed &= self.asked.is_some_and(|asked| asked <= self.doubted);
                self.asked = None;
                if POWER_CUT.contains(error) {
                    self.enabled = 0;
                }
            }
            (106, data) => {
                let codes = data.chunks_exact(2).filter_map(|pair| pair.get(1));
                self.servos.iter_mut().zip(codes).for_each(|(to, code)| *to = *code);
                (self.servos_changed, self.asked) = (false, None);
            }
            (53, data) => {
                self.reduced = Some(data).filter(|_| !response.status.invalid()).and_then(Reduced::decode);
                (self.asks_reduced, self.asked) = (self.reduced.is_some(), None);
            }
            _ => {}
        }
    }

    /// Returns the next request, if one is due. `last_sent`: time of the last request.
    pub fn due(&mut self, now: Mono, last_sent: Mono) -> Option<Command> {
        if self.asked.is_some_and(|asked| now.since(asked) < RETRY_AFTER) {
            return None;
        }
        let idle = now.since(last_sent) > HEARTBEAT;
        let command = if idle && !self.changed && self.asks_reduced && !self.asked_reduced {
            Command::ReducedMode
        } else if self.changed || idle {
            Command::GetError
        } else if self.servos_changed {
            Command::ServoErrors
        } else {
            return None;
        };
        (self.asked, self.asked_reduced) = (Some(now), command == Command::ReducedMode);
        Some(command)
    }

    /// Returns the text of the error; empty (without allocation) if there is none.
    pub fn text(&self) -> String {
        let mut text = error_text(self.error).to_owned();
        if SERVO_ERRORS.contains(&self.error) {
            let failed = self.servos.iter().enumerate().filter(|(_, code)| **code != 0);
            failed.for_each(|(i, code)| text += &format!("; joint {}: {code} {}", i + 1, servo_text(*code)));
        }
        text
    }
}
