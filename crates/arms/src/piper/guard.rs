//! Detects changes of the arm's mode and power that this run did not order: by its button, hand guiding, or another
//! program.
//!
//! They are latched until this run takes control again, so a change between two readings is seen too. Nothing here
//! undoes one.

use std::time::Duration;

use super::protocol::{Status, control_text, mode_text};
use dimos_core::clock::Mono;
use dimos_core::joint::ControlMode;

/// How long the arm may take to report an ordered mode.
const SETTLING: Duration = Duration::from_millis(100);
/// Minimum time for which motors that went off are reported as off, so that every reader sees it.
const MIN_OFF_TIME: Duration = Duration::from_millis(100);

/// A change that this run did not order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Change {
    /// Who controls the arm (0x2A1, byte 0).
    Control(u8),
    /// Its move mode (0x2A1, byte 2).
    MoveMode(u8),
    /// It is in teaching (0x2A1, byte 3).
    Teaching,
    /// Another program commands it in the same mode.
    Commands,
}

impl Change {
    /// Returns the change as text.
    pub fn text(self) -> String {
        match self {
            Self::Control(control) => format!("control went to {}", control_text(control)),
            Self::MoveMode(mode) => format!("its mode was changed to {}", mode_text(mode)),
            Self::Teaching => "it is being taught by hand".to_owned(),
            Self::Commands => "another program commands it".to_owned(),
        }
    }

    /// Returns the mode that the arm is in now, different from `ordered`.
    pub fn mode(self, ordered: ControlMode) -> ControlMode {
        match self {
            Self::MoveMode(4) | Self::Teaching | Self::Control(2 | 6) => ControlMode::Impedance,
            Self::MoveMode(5) => ControlMode::Velocity,
            Self::MoveMode(_) => ControlMode::Cartesian,
            Self::Control(_) | Self::Commands if ordered == ControlMode::Position => ControlMode::Cartesian,
            Self::Control(_) | Self::Commands => ControlMode::Position,
        }
    }
}

/// Compares the arm's reports with the orders of this run.
#[derive(Debug, Clone, Copy, Default)]
pub struct Guard {
    /// Control, move mode and teaching as ordered, and the time from which reports count; `None` while this run has no
    /// control.
    ordered: Option<((u8, u8, u8), Mono)>,
    /// The first change that this run did not order.
    pub change: Option<Change>,
    /// Whether a motor went off that this run had enabled, and when one was last seen off.
    off_at: Option<Mono>,
}

impl Guard {
    /// This run has enabled the arm, which now reports `status`.
    pub fn begin(&mut self, status: &Status, now: Mono) {
        *self = Self { ordered: Some((key(status), now)), ..Self::default() };
    }

    /// This run loses or takes control of the arm.
    pub fn release(&mut self) {
        *self = Self::default();
    }

    /// This run orders a move mode.
    pub fn order(&mut self, mode: u8, now: Mono) {
        if let Some(((_, ordered, _), from)) = &mut self.ordered
            && *ordered != mode
        {
            (*ordered, *from) = (mode, now.after(SETTLING));
        }
    }

    /// The arm reports its status.
    pub fn status(&mut self, status: &Status, now: Mono) {
        let Some(((control, mode, teaching), from)) = self.ordered else { return };
        if self.change.is_some() || now < from {
            return;
        }
        if status.control != control {
            self.change = Some(Change::Control(status.control));
        } else if status.teaching != teaching {
            self.change = Some(Change::Teaching);
        } else if status.mode != mode {
            self.change = Some(Change::MoveMode(status.mode));
        }
    }

    /// A motor is reported off.
    pub fn motor_off(&mut self, now: Mono) {
        if self.ordered.take().is_some() || self.off_at.is_some() {
            self.off_at = Some(now);
        }
    }

    /// A command of another program was received.
    pub fn commanded(&mut self) {
        if self.ordered.is_some() {
            self.change.get_or_insert(Change::Commands);
        }
    }

    /// Returns whether motors went off that this run had enabled.
    pub fn lost_power(&self) -> bool {
        self.off_at.is_some()
    }

    /// Returns whether they went off just now.
    pub fn just_off(&self, now: Mono) -> bool {
        self.off_at.is_some_and(|at| now.since(at) < MIN_OFF_TIME)
    }
}

/// The compared part of a status.
fn key(status: &Status) -> (u8, u8, u8) {
    (status.control, status.mode, status.teaching)
}

#[cfg(test)]
mod tests {
    use super::*;

    const OURS: Status = Status { control: 1, arm: 0, mode: 1, teaching: 0, limits: 0, silent: 0 };

    fn ms(n: u64) -> Mono {
        Mono(n * 1_000_000)
    }

    #[test]
    fn changes_that_were_not_ordered_are_latched() {
        for (status, change) in [
            (Status { control: 2, ..OURS }, Change::Control(2)),
            (Status { mode: 0, ..OURS }, Change::MoveMode(0)),
            (Status { teaching: 1, ..OURS }, Change::Teaching),
        ] {
            let mut guard = Guard::default();
            guard.status(&status, ms(0));
            assert_eq!(guard.change, None, "not under this run's control");
            guard.begin(&OURS, ms(1));
            guard.status(&OURS, ms(2));
            assert_eq!(guard.change, None);
            guard.status(&status, ms(3));
            guard.status(&OURS, ms(4));
            assert_eq!(guard.change, Some(change), "also when it is undone");
            for ordered in [ControlMode::Position, ControlMode::ServoPosition] {
                assert_ne!(change.mode(ordered), ordered);
                assert_ne!(Change::Commands.mode(ordered), ordered);
            }
        }
    }

    #[test]
    fn modes_that_this_run_orders_get_time_to_show() {
        let mut guard = Guard::default();
        guard.begin(&OURS, ms(0));
        guard.order(1, ms(1));
        guard.order(0, ms(10));
        guard.status(&OURS, ms(50));
        guard.status(&Status { mode: 0, ..OURS }, ms(120));
        assert_eq!(guard.change, None);
        guard.status(&OURS, ms(121));
        assert_eq!(guard.change, Some(Change::MoveMode(1)));
    }

    #[test]
    fn motors_that_go_off_end_the_control() {
        let mut guard = Guard::default();
        guard.motor_off(ms(0));
        assert!(!guard.lost_power(), "it had not switched them on");
        guard.begin(&OURS, ms(1));
        guard.motor_off(ms(5));
        assert!(guard.lost_power() && guard.just_off(ms(5)) && guard.just_off(ms(104)) && !guard.just_off(ms(105)));
        guard.status(&Status { control: 0, ..OURS }, ms(6));
        guard.commanded();
        assert_eq!(guard.change, None, "what follows from it is no change of its own");
        guard.release();
        assert!(!guard.lost_power());
    }
}
