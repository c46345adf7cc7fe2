//! A gripper that two outputs of the tool board open and close: the Lite 6's gripper and the vacuum gripper. Nothing
//! measures the fingers: the position is what the outputs say when they are read back. A vacuum gripper's switch
//! shows whether something is held. Requests use the tool's bus as those of a gripper with a motor do (`gripper.rs`).

use std::time::Duration;

use super::gripper::ToolGripper;
use super::protocol::commands::Command;
use super::protocol::frame::Response;
use super::protocol::gripper::{GripperKind, INPUTS, OUTPUTS, SET_OUTPUTS, set_output};
use dimos_core::clock::Mono;
use dimos_hardware::adapter::{AdapterError, AdapterResult};

/// Period of reading back, and while the tool board does not answer.
const POLL: Duration = Duration::from_millis(100);
const POLL_SILENT: Duration = Duration::from_millis(1000);
/// How long it is read after an order although setpoints are streamed: until its switch must have closed.
const WATCH: Duration = Duration::from_millis(1500);
/// Timeout of a request.
const TIMEOUT: Duration = Duration::from_secs(2);
/// Consecutive lost answers after which nothing is known of the gripper.
const SILENT_AFTER: u32 = 3;

/// A request to the tool board.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Step {
    /// Sets an output.
    Set(u8, bool),
    Outputs,
    Inputs,
}

/// State of the gripper, and its pending order.
#[derive(Debug, Clone, Copy)]
pub struct OutputGripper {
    kind: GripperKind,
    /// The order, whether to open, and how many of the two outputs it has set.
    wanted: Option<(bool, u8)>,
    under_way: Option<(Step, Mono)>,
    /// Whether it is open, as its outputs say; `None` before the first order, and while they cannot be read.
    open: Option<bool>,
    holds: Option<bool>,
    failures: u32,
    next_poll: Mono,
    watched_until: Mono,
    inputs_next: bool,
}

impl OutputGripper {
    /// Creates the state of a gripper of this kind.
    pub fn new(kind: GripperKind) -> Self {
        Self {
            kind,
            wanted: None,
            under_way: None,
            open: None,
            holds: None,
            failures: 0,
            next_poll: Mono::ZERO,
            watched_until: Mono::ZERO,
            inputs_next: false,
        }
    }

    /// The levels of the two outputs: the vendor's client opens a Lite 6's gripper with those that switch suction on.
    fn levels(&self, open: bool) -> (bool, bool) {
        let first = open == (self.kind == GripperKind::Lite6);
        (first, !first)
    }

    fn choose(&mut self, now: Mono, quiet: bool) -> Option<Step> {
        let silent = self.failures >= SILENT_AFTER;
        if let Some((open, set)) = self.wanted.filter(|_| !silent) {
            let (first, second) = self.levels(open);
            return Some(if set == 0 { Step::Set(0, first) } else { Step::Set(1, second) });
        }
        if now < self.next_poll || (quiet && now >= self.watched_until) {
            return None;
        }
        self.next_poll = now.after(if silent { POLL_SILENT } else { POLL });
        self.inputs_next = self.kind == GripperKind::Vacuum && !self.inputs_next;
        Some(if self.inputs_next { Step::Inputs } else { Step::Outputs })
    }

    fn failed(&mut self) {
        self.under_way = None;
        self.failures += 1;
        if self.failures >= SILENT_AFTER {
            (self.open, self.holds, self.wanted) = (None, None, None);
        }
    }
}

impl ToolGripper for OutputGripper {
    fn opening(&self) -> Option<f64> {
        self.open.filter(|_| self.wanted.is_none()).map(f64::from)
    }

    fn holds(&self) -> Option<bool> {
        self.holds
    }

    fn go_to(&mut self, opening: f64) -> AdapterResult<()> {
        let open = match opening {
            0.0 => false,
            1.0 => true,
            other => {
                let text = format!("the gripper only closes (0) and opens (1): it cannot go to {other}");
                return Err(AdapterError::Rejected(text));
            }
        };
        if self.failures >= SILENT_AFTER {
            return Err(AdapterError::Rejected("the tool board does not answer".into()));
        }
        (self.wanted, self.holds) = (Some((open, 0)), None);
        Ok(())
    }

    /// An order of which nothing is sent yet is dropped. One of two outputs is no state of a gripper: the second one
    /// follows the first.
    fn stopped(&mut self, _now: Mono) {
        let begun = matches!(self.under_way, Some((Step::Set(..), _)));
        self.wanted = self.wanted.filter(|(_, set)| begun || *set > 0);
        self.next_poll = Mono::ZERO;
    }

    fn unplugged(&mut self) {
        if self.under_way.is_some() {
            self.failed();
        }
    }

    fn due(&mut self, now: Mono, quiet: bool) -> Option<Command> {
        if let Some((_, sent)) = self.under_way {
            if now.since(sent) < TIMEOUT {
                return None;
            }
            self.failed();
        }
        let step = self.choose(now, quiet)?;
        if let Step::Set(..) = step {
            self.watched_until = now.after(WATCH);
        }
        self.under_way = Some((step, now));
        Some(match step {
            Step::Set(output, high) => Command::WriteToolBoard(SET_OUTPUTS, set_output(output, high)),
            Step::Outputs => Command::ReadToolBoard(OUTPUTS),
            Step::Inputs => Command::ReadToolBoard(INPUTS),
        })
    }

    fn take(&mut self, response: &Response) {
        let Some((step, _)) = self.under_way.take() else { return };
        let value = match response.data() {
            [_, a, b, c, d, ..] | [a, b, c, d] => Some(i32::from_be_bytes([*a, *b, *c, *d])),
            _ => None,
        };
        match (step, value) {
            _ if response.status.invalid() => return self.failed(),
            (Step::Set(output, high), _) => {
                // Another order may have come since.
                let as_wanted = |(open, set): &(bool, u8)| {
                    let levels = self.levels(*open);
                    *set == output && high == if output == 0 { levels.0 } else { levels.1 }
                };
                if self.wanted.as_ref().is_some_and(as_wanted) {
                    self.wanted = self.wanted.filter(|_| output == 0).map(|(open, _)| (open, 1));
                    // The switch is read before the outputs, which confirm the order.
                    (self.next_poll, self.inputs_next, self.open) = (Mono::ZERO, false, None);
                }
            }
            (Step::Outputs, Some(outputs)) => {
                let now = (outputs & 1 != 0, outputs & 2 != 0);
                self.open = [true, false].into_iter().find(|open| self.levels(*open) == now);
            }
            (Step::Inputs, Some(inputs)) => {
                self.holds = Some(inputs & 1 != 0);
                if self.open.is_none() {
                    self.next_poll = Mono::ZERO;
                }
            }
            (Step::Outputs | Step::Inputs, None) => return self.failed(),
        }
        self.failures = 0;
    }
}
