//! Output: data to stdout, diagnostics to stderr, aligned tables, colour on terminals only.

use std::fmt::Display;
use std::io::{self, IsTerminal, Write};
use std::os::fd::AsFd;

use comfy_table::presets::NOTHING;
use comfy_table::{Attribute, Cell, CellAlignment, Color, ContentArrangement};
use serde::Serialize;

use super::exit::Failure;

/// Minimum width of a squeezed table [columns]; below, the terminal wraps the lines.
const MIN_COLUMNS: u16 = 40;

/// Prints a line of data to stdout. A closed pipe (`| head`) is not an error.
pub fn line(text: impl Display) {
    let _ = writeln!(io::stdout().lock(), "{text}");
}

/// Prints a value to stdout as one line of JSON.
pub fn json(value: &impl Serialize) {
    // The types printed have string keys only, so encoding cannot fail.
    line(serde_json::to_string(value).unwrap_or_default());
}

/// Prints a line of diagnostics to stderr.
pub fn note(text: impl Display) {
    let _ = writeln!(io::stderr().lock(), "{text}");
}

/// Prints why a verb failed, to stderr.
pub fn failure(failure: &Failure) {
    let (on, off) = if colour(&io::stderr()) { ("\x1b[1;31m", "\x1b[0m") } else { ("", "") };
    note(format_args!("{on}error:{off} {}", failure.what));
    if let Some(hint) = &failure.hint {
        note(format_args!("hint: {hint}"));
    }
}

/// Returns whether to colour `stream`: only on a terminal, unless `NO_COLOR` is set.
pub fn colour(stream: &impl IsTerminal) -> bool {
    stream.is_terminal() && std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty())
}

/// Tone of a word.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Tone {
    /// Good.
    Good,
    /// Warning.
    Warning,
    /// Error.
    Bad,
}

/// Returns a cell with a tone.
pub fn toned(text: impl Display, tone: Tone) -> Cell {
    let colour = match tone {
        Tone::Good => Color::Green,
        Tone::Warning => Color::Yellow,
        Tone::Bad => Color::Red,
    };
    Cell::new(text).fg(colour)
}

/// Returns whether it is a terminal that reports its width and is wide enough for columns. Pseudo-terminals (`script`,
/// a container) may report 0.
fn has_width(out: impl AsFd) -> bool {
    rustix::termios::tcgetwinsize(out).is_ok_and(|size| size.ws_col >= MIN_COLUMNS)
}

/// A table without borders: aligned columns, two spaces apart.
pub struct Table(comfy_table::Table);

impl Table {
    /// Creates a table with these headings. A leading `>` aligns the column to the right.
    pub fn new(headings: &[&str]) -> Self {
        let mut table = comfy_table::Table::new();
        table.load_style(NOTHING);
        if has_width(io::stdout()) {
            // Long cells wrap within their column.
            table.set_content_arrangement(ContentArrangement::Dynamic);
        }
        if !colour(&io::stdout()) {
            table.force_no_tty();
        }
        let title = |h: &&str| Cell::new(h.trim_start_matches('>')).add_attribute(Attribute::Bold);
        table.set_header(headings.iter().map(title).collect::<Vec<_>>());
        for (column, heading) in table.column_iter_mut().zip(headings) {
            column.set_padding((0, 2));
            if heading.starts_with('>') {
                column.set_cell_alignment(CellAlignment::Right);
            }
        }
        Self(table)
    }

    /// Adds a row.
    pub fn row<C: Into<Cell>>(&mut self, cells: impl IntoIterator<Item = C>) {
        self.0.add_row(cells.into_iter().map(Into::into).collect::<Vec<Cell>>());
    }

    /// Returns its lines as printed.
    pub fn lines(&self) -> Vec<String> {
        self.0.lines().map(|row| row.trim_end().to_owned()).collect()
    }

    /// Prints it to stdout.
    pub fn print(&self) {
        self.lines().iter().for_each(line);
    }
}

/// Formats a number with this many decimals, or `-` if there is none.
pub fn number(value: Option<f64>, decimals: usize) -> String {
    value.map_or_else(|| "-".into(), |v| fixed(v, decimals))
}

/// Formats a number with this many decimals; never `-0.00`.
pub fn fixed(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    match text.strip_prefix('-') {
        Some(rest) if rest.bytes().all(|b| matches!(b, b'0' | b'.')) => rest.to_owned(),
        _ => text,
    }
}

/// Formats a duration: `2 h 5 min`, `12.3 s`.
pub fn span(seconds: f64) -> String {
    let whole = seconds as u64;
    match whole {
        0..60 => format!("{seconds:.1} s"),
        60..3600 => format!("{} min {} s", whole / 60, whole % 60),
        3600..86_400 => format!("{} h {} min", whole / 3600, whole / 60 % 60),
        _ => format!("{} d {} h", whole / 86_400, whole / 3600 % 24),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::termios::{Winsize, tcsetwinsize};

    #[test]
    fn a_terminal_without_a_width_squeezes_no_table() {
        let terminal = std::fs::File::options().read(true).write(true).open("/dev/ptmx").unwrap();
        assert!(!has_width(&terminal), "a new one has no size");
        for (columns, enough) in [(80, true), (1, false), (0, false)] {
            tcsetwinsize(&terminal, Winsize { ws_row: 24, ws_col: columns, ws_xpixel: 0, ws_ypixel: 0 }).unwrap();
            assert_eq!(has_width(&terminal), enough, "{columns}");
        }
        assert!(!has_width(std::fs::File::open("/dev/null").unwrap()));
    }
}
