//! A table that is redrawn in place while a person moves the joints.

use std::io::{self, IsTerminal, Write};

use super::super::output::Table;
use crate::hardware::service::Motor;

/// Positions that each motor has had since the beginning.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Seen {
    /// Lowest position.
    pub low: i32,
    /// Present position.
    pub now: i32,
    /// Highest position.
    pub high: i32,
}

impl Seen {
    /// One position.
    pub fn at(position: i32) -> Self {
        Self { low: position, now: position, high: position }
    }

    /// Takes the next position; returns how far it is from the one before.
    pub fn take(&mut self, position: i32) -> i32 {
        let step = position.abs_diff(self.now) as i32;
        *self = Self { low: self.low.min(position), now: position, high: self.high.max(position) };
        step
    }
}

/// Returns the lines of the table.
pub fn lines(motors: &[Motor], seen: &[Seen]) -> Vec<String> {
    let mut table = Table::new(&["JOINT", ">MIN", ">POS", ">MAX"]);
    for (motor, Seen { low, now, high }) in motors.iter().zip(seen) {
        let (low, high) = motor.range.unwrap_or((*low, *high));
        table.row([motor.name.to_owned(), low.to_string(), now.to_string(), high.to_string()]);
    }
    table.lines()
}

/// The place of the table on the terminal.
#[derive(Debug, Default)]
pub struct Place {
    drawn: usize,
}

impl Place {
    /// Draws lines over those before. Without a terminal nothing is drawn.
    pub fn draw(&mut self, lines: &[String]) {
        let out = io::stderr();
        if !out.is_terminal() {
            return;
        }
        let up = if self.drawn > 0 { format!("\x1b[{}A", self.drawn) } else { String::new() };
        let text: String = lines.iter().map(|line| format!("\r{line}\x1b[K\n")).collect();
        self.drawn = lines.len();
        let _ = out.lock().write_all(format!("{up}{text}").as_bytes());
    }
}
