//! Lines that are redrawn in place on a terminal. What the terminal has wrapped counts with all of its rows.

use std::io;
use std::os::fd::AsFd;

use super::escapes::safe;

/// The frame that was drawn last.
#[derive(Debug, Default)]
pub struct Redraw {
    /// Lengths of its lines [columns].
    drawn: Vec<usize>,
}

impl Redraw {
    /// Returns what draws `lines` in place of the frame before, on a terminal of this size [columns, rows]; 0 columns
    /// wrap nothing. Leaves out lines at the end that do not fit: what has scrolled away cannot be redrawn.
    pub fn frame(&mut self, lines: &[String], (columns, rows): (usize, usize), colour: bool) -> String {
        // A terminal that has become narrower has wrapped the lines that are there.
        let rows_of = |length: &usize| if columns == 0 { 1 } else { length.div_ceil(columns).max(1) };
        let up = self.drawn.iter().map(rows_of).sum::<usize>();
        let mut text = if up > 0 { format!("\x1b[{up}A\x1b[J") } else { String::new() };
        self.drawn.clear();
        // The cursor is in the row below.
        let mut room = rows.saturating_sub(1);
        for line in lines {
            let line = safe(line, colour);
            let length = width(&line);
            if rows > 0 && rows_of(&length) > room {
                break;
            }
            room = room.saturating_sub(rows_of(&length));
            text.push_str(&line);
            text.push('\n');
            self.drawn.push(length);
        }
        text
    }
}

/// Returns columns and rows of a terminal; 0 where it reports none.
pub fn size(out: impl AsFd) -> (usize, usize) {
    rustix::termios::tcgetwinsize(out).map_or((0, 0), |size| (size.ws_col.into(), size.ws_row.into()))
}

/// Returns the size of the terminal at stdout.
pub fn stdout_size() -> (usize, usize) {
    size(io::stdout())
}

/// Returns the columns that a line takes at most: colours take none, a tab eight.
pub fn width(line: &str) -> usize {
    let mut escaped = false;
    let is_shown = |c: &char| {
        let shown = !escaped && *c != '\x1b';
        escaped = *c == '\x1b' || (escaped && *c != 'm');
        shown
    };
    line.chars().filter(is_shown).map(|c| if c == '\t' { 8 } else { 1 }).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_take_no_columns() {
        assert_eq!(width("\x1b[1mJOINT\x1b[0m  \x1b[31m0.5\x1b[0m"), 10);
        assert_eq!(width("µs"), 2);
    }

    #[test]
    fn wrapped_lines_count_with_all_rows_and_what_does_not_fit_is_left_out() {
        let lines = ["a".repeat(25), "b".into(), "c".into()];
        let mut redraw = Redraw::default();
        assert_eq!(redraw.frame(&lines, (10, 6), false), format!("{}\nb\nc\n", lines[0]));
        assert!(redraw.frame(&lines, (10, 5), false).starts_with("\x1b[5A\x1b[J"));
        let last = redraw.frame(&lines, (30, 24), false);
        assert!(
            last.starts_with("\x1b[2A\x1b[J") && last.ends_with("\nb\nc\n"),
            "{last:?}: c had no row, a now has one"
        );
        assert!(redraw.frame(&[], (0, 0), false).starts_with("\x1b[3A"));
    }
}
