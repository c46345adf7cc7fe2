//! A table that is redrawn in place while a person moves the joints.

use std::io::{self, IsTerminal, Write};

use super::super::output::Table;
use super::super::redraw::{self, Redraw};
use dimos_hardware::service::Motor;

/// Positions that each motor has had since the beginning.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Seen {
    /// Lowest position.
    pub low: i32,
    /// Present position.
    pub now: i32,
    /// Highest position.
    pub high: i32,
    /// Whether it passed the end of its turn.
    pub passed: bool,
}

impl Seen {
    /// One position.
    pub fn at(position: i32) -> Self {
        Self { low: position, now: position, high: position, passed: false }
    }

    /// Takes the next position. A step of half a `turn` is one over its end: no joint turns that far between two.
    pub fn take(&mut self, position: i32, turn: i32) {
        let passed = self.passed || (position.abs_diff(self.now) as i32) > turn / 2;
        *self = Self { low: self.low.min(position), now: position, high: self.high.max(position), passed };
    }

    /// Returns the range of a motor. One that may have no end stops has a range of its own, unless it was led through
    /// most of a `turn` and not over its end.
    pub fn range(&self, motor: &Motor, turn: i32) -> (i32, i32) {
        let stops = !self.passed && self.high - self.low > turn / 2;
        motor.range.filter(|_| !stops).unwrap_or((self.low, self.high))
    }
}

/// Returns the lines of the table.
pub fn lines(motors: &[Motor], seen: &[Seen], turn: i32) -> Vec<String> {
    let mut table = Table::new(&["JOINT", ">MIN", ">POS", ">MAX"]);
    for (motor, seen) in motors.iter().zip(seen) {
        let (low, high) = seen.range(motor, turn);
        table.row([motor.name.to_owned(), low.to_string(), seen.now.to_string(), high.to_string()]);
    }
    table.lines()
}

/// The place of the table on the terminal.
#[derive(Debug, Default)]
pub struct Place(Redraw);

impl Place {
    /// Draws lines over those before. Without a terminal nothing is drawn.
    pub fn draw(&mut self, lines: &[String]) {
        let out = io::stderr();
        if out.is_terminal() {
            let text = self.0.frame(lines, redraw::size(&out), true);
            let _ = out.lock().write_all(text.as_bytes());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_joint_that_may_turn_on_has_the_range_between_its_end_stops_or_the_whole_turn() {
        let roll = Motor { name: "roll", id: 5, range: Some((0, 4095)) };
        let led = |positions: &[i32]| {
            let mut seen = Seen::at(2047);
            positions.iter().for_each(|position| seen.take(*position, 4096));
            seen
        };
        assert_eq!(led(&[1000, 300, 1800, 3500]).range(&roll, 4096), (300, 3500));
        assert_eq!(led(&[1900, 2300]).range(&roll, 4096), (0, 4095), "hardly moved");
        let over = led(&[3500, 4090, 5, 1000]);
        assert!(over.passed && over.range(&roll, 4096) == (0, 4095));
        assert_eq!(led(&[1900, 2300]).range(&Motor { range: None, ..roll }, 4096), (1900, 2300));
    }
}
