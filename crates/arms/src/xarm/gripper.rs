//! The gripper, one telegram at a time: each takes 10 to 100 ms on the tool's bus, so no caller waits for one. Commands
//! wait for their turn; the position is polled and answered from memory.
//!
//! Telegrams use the second control port. In a box without one they share the connection with the setpoints, which
//! would wait behind each telegram: there a gripper at rest is not polled while setpoints are streamed.

use std::time::Duration;

use super::errors::gripper_text;
use super::protocol::commands::Command;
use super::protocol::frame::Response;
use super::protocol::gripper::{FORCE_G2, FORCE_RANGE_G2, GripperKind, Rtu, decode_error, decode_position};
use dimos_core::clock::Mono;
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::adapter_util::within;

/// Period of polling, and while the gripper does not answer.
const POLL: Duration = Duration::from_millis(100);
const POLL_SILENT: Duration = Duration::from_millis(1000);
/// How long the gripper is polled after a stop, to see whether it still moves.
const WATCH: Duration = Duration::from_millis(500);
/// Timeout of a telegram.
const TIMEOUT: Duration = Duration::from_secs(2);
/// Number of equal positions, within a few pulses, after which a gripper is at rest.
const RESTS_AFTER: u32 = 10;
const SAME_PULSES: u32 = 2;
/// Consecutive lost telegrams after which there is no gripper.
const SILENT_AFTER: u32 = 3;
/// Number of positions between two requests for the error.
const ERROR_EVERY: u32 = 10;

/// Purpose of a telegram.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Step {
    Clear,
    Enable,
    Mode,
    Speed,
    /// To these pulses with this force [%].
    Go(i32, u16),
    Error,
    Position,
}

/// A gripper at the tool flange, as the session sees it.
pub trait ToolGripper: Send {
    /// Returns its position, if known: opening [m], or 0 closed and 1 open.
    fn opening(&self) -> Option<f64>;
    /// Returns whether it reports an object in its grip, if it can tell.
    fn holds(&self) -> Option<bool> {
        None
    }
    /// Queues a move to a position.
    fn go_to(&mut self, opening: f64) -> AdapterResult<()>;
    /// Queues a move to an opening [m] with a largest force [%].
    fn grip(&mut self, _opening: f64, _force: f64) -> AdapterResult<()> {
        Err(AdapterError::Unsupported)
    }
    /// Sets the speed of the moves that follow, as a fraction of its top speed; `None`: the default.
    fn set_speed(&mut self, _speed: Option<f64>) {}
    /// The arm was stopped. An unsent target is dropped.
    fn stopped(&mut self, now: Mono);
    /// Queues the clearing of its error.
    fn clear_error(&mut self) {}
    /// Its connection was closed.
    fn unplugged(&mut self);
    /// Returns the next request, if one is due. `quiet`: requests would delay setpoints, so only urgent ones are sent.
    fn due(&mut self, now: Mono, quiet: bool) -> Option<Command>;
    /// Takes the response to the outstanding request.
    fn take(&mut self, response: &Response);
}

/// State of the gripper, and its pending commands.
#[derive(Debug, Clone, Copy)]
pub struct Gripper {
    kind: GripperKind,
    /// The next step before it takes targets; `None` when it is ready.
    wake: Option<Step>,
    /// Pulses and force [%].
    wanted: Option<(i32, u16)>,
    clear: bool,
    under_way: Option<(Step, Rtu, Mono)>,
    pulses: Option<i32>,
    error: u16,
    failures: u32,
    /// Consecutive equal positions.
    same: u32,
    next_poll: Mono,
    watched_until: Mono,
    polls: u32,
    /// Fraction of its top speed for the next targets; `None`: the default.
    speed: Option<f64>,
}

impl Gripper {
    /// Creates the state of a gripper found at `pulses`.
    pub fn new(kind: GripperKind, pulses: Option<i32>) -> Self {
        Self {
            kind,
            wake: Some(Step::Enable),
            wanted: None,
            clear: false,
            under_way: None,
            pulses,
            error: 0,
            failures: 0,
            same: RESTS_AFTER,
            next_poll: Mono::ZERO,
            watched_until: Mono::ZERO,
            polls: 0,
            speed: None,
        }
    }

    /// Returns the smallest and the largest force [%]; `None` for a gripper without force control.
    pub fn force_range(&self) -> Option<(f64, f64)> {
        (self.kind == GripperKind::XarmG2).then_some(FORCE_RANGE_G2)
    }

    fn go(&mut self, opening: f64, force: u16) -> AdapterResult<()> {
        let widest = self.kind.widest().ok_or(AdapterError::Unsupported)?;
        if !(0.0..=widest).contains(&opening) {
            return Err(AdapterError::Rejected(format!("the gripper opens 0 to {widest} m, not {opening} m")));
        }
        if self.failures >= SILENT_AFTER {
            return Err(AdapterError::Rejected("the gripper does not answer".into()));
        }
        if self.error != 0 {
            let text = format!("gripper: {}", gripper_text(self.error));
            return Err(AdapterError::Fault { code: self.error.into(), text });
        }
        self.wanted = Some((self.kind.pulses(opening), force));
        Ok(())
    }

    /// Returns whether there is nothing to send and nothing to wait for.
    fn rests(&self, now: Mono) -> bool {
        let asked = self.clear || self.wanted.is_some() || now < self.watched_until;
        !asked && self.pulses.is_some() && self.same >= RESTS_AFTER
    }

    fn choose(&mut self, now: Mono) -> Option<Step> {
        let silent = self.failures >= SILENT_AFTER;
        if self.clear && !silent {
            return Some(Step::Clear);
        }
        if let Some((pulses, force)) = self.wanted.filter(|_| !silent) {
            return Some(self.wake.unwrap_or(Step::Go(pulses, force)));
        }
        if now < self.next_poll && (silent || now >= self.watched_until) {
            return None;
        }
        self.next_poll = now.after(if silent { POLL_SILENT } else { POLL });
        self.polls = self.polls.wrapping_add(1);
        Some(if self.polls.is_multiple_of(ERROR_EVERY) { Step::Error } else { Step::Position })
    }

    fn failed(&mut self) {
        self.under_way = None;
        self.failures += 1;
        if self.failures >= SILENT_AFTER {
            // Its position and target are unknown now.
            (self.pulses, self.wanted, self.wake, self.clear) = (None, None, Some(Step::Enable), false);
        }
    }
}

impl ToolGripper for Gripper {
    fn opening(&self) -> Option<f64> {
        self.pulses.map(|pulses| self.kind.opening(pulses))
    }

    fn grip(&mut self, opening: f64, force: f64) -> AdapterResult<()> {
        let range = self.force_range().ok_or(AdapterError::Unsupported)?;
        let force = within("gripper force", force, range, "%")?;
        self.go(opening, force.round() as u16)
    }

    fn set_speed(&mut self, speed: Option<f64>) {
        if self.kind == GripperKind::Xarm && self.speed != speed {
            self.wake.get_or_insert(Step::Speed);
        }
        self.speed = speed;
    }

    fn go_to(&mut self, opening: f64) -> AdapterResult<()> {
        self.go(opening, FORCE_G2)
    }

    /// The next positions show whether the gripper still moves.
    fn stopped(&mut self, now: Mono) {
        self.wanted = None;
        self.watched_until = now.after(WATCH);
    }

    fn clear_error(&mut self) {
        self.clear |= self.error != 0;
    }

    fn unplugged(&mut self) {
        if self.under_way.is_some() {
            self.failed();
        }
    }

    fn due(&mut self, now: Mono, quiet: bool) -> Option<Command> {
        if self.kind == GripperKind::None || (quiet && (self.rests(now) || self.failures >= SILENT_AFTER)) {
            return None;
        }
        if let Some((_, _, sent)) = self.under_way {
            if now.since(sent) < TIMEOUT {
                return None;
            }
            self.failed();
        }
        let step = self.choose(now)?;
        let telegram = match step {
            Step::Clear => Rtu::clear_error(),
            Step::Enable => Rtu::enable(),
            Step::Mode => Rtu::position_mode(),
            Step::Speed => Rtu::speed(self.speed),
            Step::Go(pulses, force) => Rtu::go(self.kind, pulses, force, self.speed),
            Step::Error => Rtu::read_error(),
            Step::Position => Rtu::read_position(),
        };
        self.under_way = Some((step, telegram, now));
        Some(Command::Tool(telegram))
    }

    fn take(&mut self, response: &Response) {
        let Some((step, telegram, _)) = self.under_way.take() else { return };
        let Some(data) = telegram.answered(response.data()) else { return self.failed() };
        self.failures = 0;
        match step {
            Step::Clear => (self.clear, self.error, self.wake) = (false, 0, Some(Step::Enable)),
            Step::Enable => self.wake = Some(Step::Mode),
            Step::Mode if self.kind == GripperKind::Xarm => self.wake = Some(Step::Speed),
            // Another speed may have been set since.
            Step::Speed if telegram != Rtu::speed(self.speed) => {}
            Step::Mode | Step::Speed => self.wake = None,
            Step::Go(pulses, force) => {
                self.same = 0;
                self.wanted = self.wanted.filter(|wanted| *wanted != (pulses, force));
                self.polls = ERROR_EVERY - 1; // its error shows whether it accepted the target
                self.next_poll = Mono::ZERO;
            }
            Step::Error => {
                self.error = decode_error(data).unwrap_or(self.error);
                if self.error != 0 {
                    (self.wanted, self.wake) = (None, Some(Step::Enable));
                }
            }
            Step::Position => {
                let pulses = decode_position(data).or(self.pulses);
                let same = pulses.zip(self.pulses).is_some_and(|(a, b)| a.abs_diff(b) <= SAME_PULSES);
                self.same = if same { self.same.saturating_add(1) } else { 0 };
                self.pulses = pulses;
            }
        }
    }
}
