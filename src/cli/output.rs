//! Printing: data to stdout, diagnostics to stderr, tables that align, colour only for eyes.

use std::fmt::Display;
use std::io::{self, IsTerminal, Write};
use std::os::fd::AsFd;

use comfy_table::presets::NOTHING;
use comfy_table::{Attribute, Cell, CellAlignment, Color, ContentArrangement};
use serde::Serialize;

use super::exit::Failure;

/// In fewer columns than these a table is not squeezed: the terminal breaks its lines.
const NARROWEST: u16 = 40;

/// Prints a line of data to stdout. That nobody reads it any more (`| head`) is no error.
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

/// Whether to colour what goes to `stream`: only on a terminal, and not where `NO_COLOR` is set.
pub fn colour(stream: &impl IsTerminal) -> bool {
    stream.is_terminal() && std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty())
}

/// How a word strikes the eye.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Tone {
    /// As it should be.
    Good,
    /// Worth a look.
    Warning,
    /// Wrong.
    Bad,
}

/// A cell with a tone.
pub fn toned(text: impl Display, tone: Tone) -> Cell {
    let colour = match tone {
        Tone::Good => Color::Green,
        Tone::Warning => Color::Yellow,
        Tone::Bad => Color::Red,
    };
    Cell::new(text).fg(colour)
}

/// Whether it is a terminal that says how wide it is, and is not too narrow for columns. One that a program has opened
/// (`script`, a container) may say 0.
fn has_width(out: impl AsFd) -> bool {
    rustix::termios::tcgetwinsize(out).is_ok_and(|size| size.ws_col >= NARROWEST)
}

/// A table without lines: columns aligned, two spaces apart.
pub struct Table(comfy_table::Table);

impl Table {
    /// A table with these headings. One that starts with `>` heads a column of numbers, aligned to the right.
    pub fn new(headings: &[&str]) -> Self {
        let mut table = comfy_table::Table::new();
        table.load_style(NOTHING);
        if has_width(io::stdout()) {
            // What does not fit goes on below, in its own column.
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

    /// Its lines, as they are printed.
    pub fn lines(&self) -> Vec<String> {
        self.0.lines().map(|row| row.trim_end().to_owned()).collect()
    }

    /// Prints it to stdout.
    pub fn print(&self) {
        self.lines().iter().for_each(line);
    }
}

/// A number with so many decimals, or `-` where there is none.
pub fn number(value: Option<f64>, decimals: usize) -> String {
    value.map_or_else(|| "-".into(), |v| fixed(v, decimals))
}

/// A number with so many decimals; never `-0.00`.
pub fn fixed(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    match text.strip_prefix('-') {
        Some(rest) if rest.bytes().all(|b| matches!(b, b'0' | b'.')) => rest.to_owned(),
        _ => text,
    }
}

/// A span of time as people say it: `2 h 5 min`, `12.3 s`.
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
