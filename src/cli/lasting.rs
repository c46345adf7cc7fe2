//! A connection to a run on another computer that is opened again after a loss. For verbs that continue until Ctrl-C; a
//! run on this computer has ended when its connection ends.

use std::thread::sleep;
use std::time::{Duration, Instant};

use super::arguments::place;
use super::output;
use crate::share;
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::error::Code;

/// Pause between two attempts.
const PAUSE: Duration = Duration::from_millis(200);

/// Returns whether a connection to another computer is lost, or its run has ended.
pub fn is_lost(error: &ClientError) -> bool {
    let lost = match error {
        ClientError::Io { .. } => !error.is_timeout(),
        ClientError::Refused(refusal) => {
            matches!(refusal.code, Code::Lost | Code::ShuttingDown | Code::Unreachable | Code::NoAnswer)
        }
        _ => false,
    };
    lost && place().is_some()
}

/// Connects again, and says what is lost, and when it is back. Waits until then.
pub fn again(run: &str, why: &ClientError) -> Result<Client, ClientError> {
    let began = Instant::now();
    let mut said = why.to_string();
    output::note(format_args!("{said}; waiting for it, Ctrl-C ends that"));
    loop {
        // First of all: a gateway whose run has ended still listens for a moment.
        sleep(PAUSE);
        match attempt(run) {
            Ok(client) => {
                let (place, took) = (place().unwrap_or_default(), began.elapsed().as_secs_f64());
                output::note(format_args!("connected to run {run} at {place} again after {took:.1} s"));
                return Ok(client);
            }
            Err(error) if is_final(&error) => return Err(error),
            Err(error) => {
                let text = error.to_string();
                if text != said {
                    output::note(format_args!("{text}; still waiting"));
                    said = text;
                }
            }
        }
    }
}

/// Connects again if the run can be reached now; may wait for half a second.
pub fn attempt(run: &str) -> Result<Client, ClientError> {
    share::connect_again(place().unwrap_or_default(), run)
}

/// Returns whether it makes no sense to try again: the reason is on this computer.
pub fn is_final(error: &ClientError) -> bool {
    matches!(error, ClientError::Refused(refusal) if matches!(refusal.code, Code::InvalidParams | Code::Unsupported))
}
