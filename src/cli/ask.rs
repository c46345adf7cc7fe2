//! Questions to a person at the terminal. Waiting for an answer also ends with a signal: reading alone would continue
//! after Ctrl-C.

use std::io::{self, IsTerminal};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::termios::{QueueSelector, tcflush};

use super::exit::{Exit, Failure, Result};
use super::follow::Signals;
use super::output;

/// How often a wait checks for signals.
const CHECK_PERIOD: Duration = Duration::from_millis(100);
/// Longest line.
const LINE: usize = 1024;

/// What arrived from the terminal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Typed {
    /// A line, without blanks around it.
    Line(String),
    /// Nothing yet.
    Nothing,
    /// Its end: it is closed.
    End,
}

/// Returns what was typed, waiting up to `limit` for Enter.
pub fn typed(limit: Duration) -> Typed {
    let stdin = io::stdin();
    let limit = Timespec { tv_sec: limit.as_secs() as i64, tv_nsec: limit.subsec_nanos().into() };
    match poll(&mut [PollFd::new(&stdin, PollFlags::IN)], Some(&limit)) {
        Ok(0) | Err(Errno::INTR) => Typed::Nothing,
        Ok(_) => {
            // Not buffered: a second line must wake the next call.
            let mut room = [0; LINE];
            match rustix::io::read(&stdin, &mut room) {
                Ok(0) | Err(_) => Typed::End,
                Ok(n) => Typed::Line(String::from_utf8_lossy(room.get(..n).unwrap_or_default()).trim().to_owned()),
            }
        }
        Err(_) => Typed::End,
    }
}

/// Waits for a line; `None` after a signal, or if the terminal is closed.
pub fn line(signals: &Signals) -> Option<String> {
    while signals.last().is_none() {
        match typed(CHECK_PERIOD) {
            Typed::Line(line) => return Some(line).filter(|_| signals.last().is_none()),
            Typed::Nothing => {}
            Typed::End => return None,
        }
    }
    None
}

/// Fails where there is no terminal at which somebody could answer; `instead` is the hint.
pub fn needs_terminal(instead: &str) -> Result<()> {
    if io::stdin().is_terminal() && io::stderr().is_terminal() {
        return Ok(());
    }
    Err(Failure::usage("stdin is not a terminal: the questions cannot be answered").hint(instead))
}

/// Discards what was typed before a question: an Enter pressed too early must not answer it.
pub fn discard_typed() {
    // Only a terminal has a queue that can be discarded.
    let _ = tcflush(io::stdin(), QueueSelector::IFlush);
}

/// Prints what to do, and waits for an Enter that is pressed after that. An error after a signal, and at the end of
/// input.
pub fn enter(signals: &Signals, what: &str) -> Result<()> {
    discard_typed();
    output::note(format_args!("{what}, then press Enter (Ctrl-C ends this)"));
    line(signals).map(drop).ok_or_else(|| interrupted(signals))
}

/// The failure of a verb that a signal or a closed terminal has ended.
pub fn interrupted(signals: &Signals) -> Failure {
    match signals.last() {
        Some(signal) => Failure::new(Exit::by_signal(signal), "interrupted"),
        None => Failure::new(Exit::Failed, "interrupted: the terminal is closed, or its input ended (Ctrl-D)")
            .hint("start again, and answer with Enter"),
    }
}
