//! Changing the mode. The firmware silently falls back to mode 0 when it changes between streaming modes while it is
//! ready. Therefore the arm is stopped, then its mode is set, then it is made ready; each step must show in the reports
//! before the next.

use std::time::Duration;

use super::protocol::commands::{Command, READY, STOP};
use super::protocol::report::Motion;
use dimos_core::clock::Mono;

/// Timeout of a step to show in the reports: the reply timeout of its command.
const STEP_LIMIT: Duration = Duration::from_secs(2);
/// Pause between the steps of further attempts, as the vendor advises.
const PAUSE: Duration = Duration::from_millis(100);
/// Maximum number of attempts.
const ATTEMPTS: u32 = 3;

/// Returns whether the arm accepts motion in this state: 1 moving, 2 ready.
pub fn is_ready(state: u8) -> bool {
    state <= 2
}

/// Returns whether this state is a stop: 4 stopped, 5 mode changed.
fn is_stopped(state: u8) -> bool {
    state == 4 || state == 5
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Step {
    Begin,
    Stopping,
    Setting,
    Readying,
}

/// The next step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Next {
    /// Send this command.
    Send(Command),
    /// Wait for the next report.
    Wait,
    /// The arm is ready in its mode.
    Done,
    /// Another client changes the mode.
    TakenOver,
    /// The change has failed; why.
    GiveUp(&'static str),
}

/// A change of mode under way.
#[derive(Debug, Clone, Copy)]
pub struct ModeChange {
    /// The target mode.
    pub target: u8,
    /// The mode before the change.
    from: Option<u8>,
    detect: bool,
    step: Step,
    since: Mono,
    attempt: u32,
}

impl ModeChange {
    /// Starts a change of mode. `detect`: the firmware has the parameter for collision detection.
    pub fn new(target: u8, detect: bool, now: Mono) -> Self {
        Self { target, from: None, detect, step: Step::Begin, since: now, attempt: 1 }
    }

    /// Returns the next step, given the newest report.
    pub fn advance(&mut self, motion: &Motion, now: Mono) -> Next {
        let waited = now.since(self.since);
        if self.attempt > 1 && waited < PAUSE {
            return Next::Wait;
        }
        let there = motion.mode == self.target;
        // The mode is the old one, the target, or silently 0. Any other one was set by another client and is not
        // undone.
        if !there && motion.mode != 0 && motion.mode != *self.from.get_or_insert(motion.mode) {
            return Next::TakenOver;
        }
        match self.step {
            Step::Begin if there && is_ready(motion.state) => return Next::Done,
            Step::Begin if !is_stopped(motion.state) => return self.send(Step::Stopping, Command::SetState(STOP), now),
            Step::Begin => return self.set(now),
            Step::Stopping if is_stopped(motion.state) => return self.set(now),
            Step::Setting if there && is_stopped(motion.state) => {
                return self.send(Step::Readying, Command::SetState(READY), now);
            }
            Step::Readying if is_ready(motion.state) && there => return Next::Done,
            Step::Readying if is_ready(motion.state) && self.attempt < ATTEMPTS => {
                (self.step, self.since, self.attempt) = (Step::Begin, now, self.attempt + 1);
                return Next::Wait;
            }
            Step::Readying if is_ready(motion.state) => return Next::GiveUp("it falls back into another mode"),
            _ if waited < STEP_LIMIT => return Next::Wait,
            _ => {}
        }
        Next::GiveUp(match self.step {
            Step::Begin | Step::Stopping => "it does not stop",
            Step::Setting => "it does not take the mode",
            Step::Readying => "it does not become ready",
        })
    }

    fn set(&mut self, now: Mono) -> Next {
        self.send(Step::Setting, Command::SetMode { mode: self.target, detect: self.detect }, now)
    }

    fn send(&mut self, step: Step, command: Command, now: Mono) -> Next {
        (self.step, self.since) = (step, now);
        Next::Send(command)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reported(state: u8, mode: u8) -> Motion {
        Motion { state, mode, ..Motion::default() }
    }

    #[test]
    fn it_goes_through_a_stop_and_sees_every_step() {
        let now = Mono(1);
        let mut change = ModeChange::new(4, true, now);
        assert_eq!(change.advance(&reported(2, 1), now), Next::Send(Command::SetState(STOP)));
        assert_eq!(change.advance(&reported(2, 1), now), Next::Wait);
        assert_eq!(change.advance(&reported(4, 1), now), Next::Send(Command::SetMode { mode: 4, detect: true }));
        assert_eq!(change.advance(&reported(5, 1), now), Next::Wait, "not before the mode shows");
        assert_eq!(change.advance(&reported(5, 4), now), Next::Send(Command::SetState(READY)));
        assert_eq!(change.advance(&reported(2, 4), now), Next::Done);
        assert_eq!(ModeChange::new(4, true, now).advance(&reported(1, 4), now), Next::Done, "nothing to change");
    }

    #[test]
    fn a_mode_of_another_client_is_not_undone() {
        let now = Mono(1);
        let mut change = ModeChange::new(4, true, now);
        assert_eq!(change.advance(&reported(2, 1), now), Next::Send(Command::SetState(STOP)));
        assert_eq!(change.advance(&reported(2, 2), now), Next::TakenOver);
    }

    #[test]
    fn a_silent_mode_0_is_retried_with_pauses_and_then_given_up() {
        let mut now = Mono(1);
        let mut change = ModeChange::new(1, false, now);
        let mut sent = 0;
        let mut reports = reported(5, 0);
        let end = loop {
            now = now.after(Duration::from_millis(10));
            match change.advance(&reports, now) {
                Next::Send(Command::SetMode { .. }) => reports = reported(5, 1),
                Next::Send(Command::SetState(READY)) => (sent, reports) = (sent + 1, reported(2, 0)),
                Next::Send(_) => reports = reported(4, reports.mode),
                Next::Wait => {}
                end => break end,
            }
        };
        assert_eq!((sent, end), (3, Next::GiveUp("it falls back into another mode")));
        let mut stuck = ModeChange::new(1, false, now);
        stuck.advance(&reported(2, 0), now);
        let end = stuck.advance(&reported(2, 0), now.after(STEP_LIMIT));
        assert_eq!(end, Next::GiveUp("it does not stop"));
    }
}
