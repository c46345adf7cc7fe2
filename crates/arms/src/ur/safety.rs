//! Stops by the safety system: when they are seen, and how they are reported.

use std::time::Duration;

use super::protocol::status::{code_text, moves, safety, safety_text};
use super::session::Session;
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_hardware::adapter::{AdapterError, AdapterResult};

/// The error of a stop is reported this long after the stop at the latest: until then only its kind is known.
const ERROR_DELAY: Duration = Duration::from_millis(100);
/// An error this much older than a stop is not its cause.
const ERROR_AGE: Duration = Duration::from_secs(1);

/// A stop by the safety system.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stopped {
    /// The safety mode.
    pub mode: i32,
    /// When it was first seen.
    pub since: Mono,
    /// C code and A argument of its error, once known.
    pub error: Option<(i32, i32)>,
}

impl Session {
    /// Records the safety system's stops.
    pub(super) fn see_safety(&mut self) {
        let mode = self.state.safety_mode;
        if moves(mode) {
            self.stopped = None;
            return;
        }
        // Another safety mode is another stop: its error may be another one, too.
        if self.stopped.is_none_or(|stopped| stopped.mode != mode) {
            self.stopped = Some(Stopped { mode, since: self.measured.arrived, error: None });
        }
        self.end_due |= self.ready.take().is_some();
    }

    /// Finds the error of the present stop.
    pub(super) fn see_error(&mut self) {
        if let (Some(stopped), Some((code, argument, at))) =
            (&mut self.stopped, self.primary.as_ref().and_then(|primary| primary.error))
            && stopped.error.is_none()
            && stopped.since.since(at) < ERROR_AGE
        {
            stopped.error = Some((code, argument));
        }
    }

    /// Returns the stop that is reported as an error, and its code. A stop is reported with its error, which comes on
    /// another connection, or after [`ERROR_DELAY`] without it.
    fn reported(&self) -> Option<(Stopped, i32)> {
        let stopped = self.stopped?;
        let code = match stopped.error {
            Some((code, _)) => code,
            None if MonotonicClock.now().since(stopped.since) < ERROR_DELAY => return None,
            None => stopped.mode,
        };
        Some((stopped, code))
    }

    /// Returns the error code; 0 without an error.
    pub fn error(&self) -> (i32, String) {
        self.reported().map_or_else(Default::default, |(stopped, code)| (code, describe(&stopped)))
    }

    /// Returns `Fault` during a stop by the safety system.
    pub(super) fn fault(&self) -> AdapterResult<()> {
        match self.stopped {
            None => Ok(()),
            Some(stopped) => {
                let code = stopped.error.map_or(stopped.mode, |(code, _)| code);
                Err(AdapterError::Fault { code, text: describe(&stopped) })
            }
        }
    }

    /// Uses the error of a stop that was seen on an earlier connection, if it is still the present one.
    pub fn remember(&mut self, before: Stopped) {
        if let Some(stopped) = self.stopped.as_mut().filter(|stopped| stopped.mode == before.mode) {
            *stopped = before;
        }
    }
}

/// Describes a stop: `protective stop (C153A1: a joint deviates …)`.
fn describe(stopped: &Stopped) -> String {
    let text = safety_text(stopped.mode);
    match stopped.error {
        Some((code, argument)) => match code_text(code) {
            "" => format!("{text} (C{code}A{argument})"),
            cause => format!("{text} (C{code}A{argument}: {cause})"),
        },
        None if stopped.mode == safety::PROTECTIVE_STOP => format!("{text}, the pendant's log has its cause"),
        None => text.to_owned(),
    }
}
