//! Output: data to stdout, diagnostics to stderr, aligned tables, colour on terminals only.

use std::fmt::Display;
use std::io::{self, IsTerminal, Write};
use std::os::fd::AsFd;
use std::sync::OnceLock;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::Duration;

use comfy_table::presets::NOTHING;
use comfy_table::{Attribute, Cell, CellAlignment, Color, ColumnConstraint, ContentArrangement, Width};
use serde::Serialize;

use super::escapes::{in_json, safe};
use super::exit::{Exit, Failure};
use super::redraw;
use dimos_rpc::run_dir::LiveRun;

/// Minimum width of a squeezed table [columns]; below, the terminal wraps the lines.
const MIN_COLUMNS: u16 = 40;
/// Minimum width of a column whose text may wrap [columns]: no word of it is longer.
const MIN_TEXT: u16 = 20;

/// Constraint of such a column.
const TEXT: ColumnConstraint = ColumnConstraint::LowerBoundary(Width::Fixed(MIN_TEXT));

/// The first failed write to stdout.
static FAILED_WRITE: OnceLock<String> = OnceLock::new();

/// Prints a line of data to stdout, as a terminal may get it. [`finish`] reports a write that failed.
pub fn line(text: impl Display) {
    let out = io::stdout();
    written(writeln!(out.lock(), "{}", safe(&text.to_string(), colour(&out))));
}

/// Prints a sentence to stdout; a terminal that is narrower gets it in several lines, indented below the first.
pub fn wrapped(text: impl Display) {
    folded(&text.to_string(), columns(io::stdout())).iter().for_each(line);
}

/// Breaks a text at blanks; the lines below the first are indented.
pub fn folded(text: &str, width: Option<u16>) -> Vec<String> {
    let Some(width) = width.map(usize::from) else { return vec![text.to_owned()] };
    let indent = text.len() - text.trim_start().len() + 2;
    let mut lines: Vec<String> = Vec::new();
    for word in text.split(' ') {
        match lines.last_mut() {
            Some(last) if redraw::width(last) + 1 + redraw::width(word) <= width => {
                last.push(' ');
                last.push_str(word);
            }
            Some(_) => lines.push(format!("{:indent$}{word}", "")),
            None => lines.push(word.to_owned()),
        }
    }
    lines
}

/// Prints data as it is to stdout; returns whether it still can be written.
pub fn data(bytes: &[u8]) -> bool {
    let mut out = io::stdout().lock();
    written(out.write_all(bytes).and_then(|()| out.flush()))
}

/// Takes note of the result of a write to stdout; returns whether it succeeded. A closed pipe (`| head`) is no failure.
pub fn written(result: io::Result<()>) -> bool {
    if let Err(error) = &result
        && error.kind() != io::ErrorKind::BrokenPipe
    {
        let _ = FAILED_WRITE.set(error.to_string());
    }
    result.is_ok()
}

/// Writes what is left to stdout. The failure: something of it could not be written.
pub fn finish() -> Result<(), Failure> {
    written(io::stdout().lock().flush());
    match FAILED_WRITE.get() {
        None => Ok(()),
        Some(error) => {
            let what = format!("cannot write to standard output: {error}");
            Err(Failure::new(Exit::Failed, what).hint("what was printed is not complete"))
        }
    }
}

/// Prints what was done: a sentence, or JSON.
pub fn done(what: impl Display, data: serde_json::Value, as_json: bool) {
    if as_json { json(&data) } else { line(what) }
}

/// Prints a value to stdout as one line of JSON.
pub fn json(value: &impl Serialize) {
    line(encoded(value));
}

/// Returns a value as one line of JSON, as a terminal may get it.
pub fn encoded(value: &impl Serialize) -> String {
    // The types printed have string keys only, so encoding cannot fail.
    in_json(&serde_json::to_string(value).unwrap_or_default()).into_owned()
}

/// Prints a line of diagnostics to stderr, as a terminal may get it.
pub fn note(text: impl Display) {
    let out = io::stderr();
    let _ = writeln!(out.lock(), "{}", safe(&text.to_string(), colour(&out)));
}

/// Prints a note if a run has not answered after a second, unless the result was dropped by then: `advice`, what the
/// user can do meanwhile.
#[must_use]
pub fn note_if_slow(run: &LiveRun, advice: &'static str) -> Sender<()> {
    const SLOW: Duration = Duration::from_secs(1);
    let (answered, answer) = channel::<()>();
    let who = format!("run {} (pid {})", run.name, run.pid);
    std::thread::spawn(move || {
        if answer.recv_timeout(SLOW) == Err(RecvTimeoutError::Timeout) {
            note(format_args!("{who} has not answered for {} s: {advice}", SLOW.as_secs()));
        }
    });
    answered
}

/// Prints why a verb failed, to stderr.
pub fn failure(failure: &Failure) {
    let (on, off) = if colour(&io::stderr()) { ("\x1b[1;31m", "\x1b[0m") } else { ("", "") };
    let code = if failure.code.is_empty() { String::new() } else { format!(" [{}]", failure.code) };
    note(format_args!("{on}error:{off} {}{code}", failure.what));
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

/// Returns the columns of a terminal that reports them and has enough for tables. Pseudo-terminals (`script`, a
/// container) may report 0.
pub fn columns(out: impl AsFd) -> Option<u16> {
    rustix::termios::tcgetwinsize(out).ok().map(|size| size.ws_col).filter(|columns| *columns >= MIN_COLUMNS)
}

/// A table without borders: aligned columns, two spaces apart.
pub struct Table {
    table: comfy_table::Table,
    width: Option<u16>,
    /// Which columns are left out where they do not fit.
    optional: Vec<bool>,
}

impl Table {
    /// Creates a table with these headings. A leading `>` aligns the column to the right, a leading `~` lets its text
    /// wrap at blanks on a narrow terminal; all other columns, and the names in them, stay whole. Columns with a `?`
    /// are left out where they do not fit, the last first.
    pub fn new(headings: &[&str]) -> Self {
        Self::of_width(headings, columns(io::stdout()))
    }

    fn of_width(headings: &[&str], width: Option<u16>) -> Self {
        let mut table = comfy_table::Table::new();
        table.load_style(NOTHING);
        if let Some(width) = width {
            table.set_content_arrangement(ContentArrangement::Dynamic).set_width(width);
        }
        if !colour(&io::stdout()) {
            table.force_no_tty();
        }
        let title = |h: &&str| Cell::new(h.trim_start_matches(['>', '~', '?'])).add_attribute(Attribute::Bold);
        table.set_header(headings.iter().map(title).collect::<Vec<_>>());
        let last = headings.len().saturating_sub(1);
        for (index, (column, heading)) in table.column_iter_mut().zip(headings).enumerate() {
            // Blanks at the end of a line that is full would wrap.
            column.set_padding((0, if index == last { 0 } else { 2 }));
            if heading.starts_with('>') {
                column.set_cell_alignment(CellAlignment::Right);
            }
            let is_text = heading.starts_with('~');
            column.set_constraint(if is_text { TEXT } else { ColumnConstraint::ContentWidth });
        }
        let optional = headings.iter().map(|h| h.trim_start_matches(['>', '~']).starts_with('?')).collect();
        Self { table, width, optional }
    }

    /// Adds a row.
    pub fn row<C: Into<Cell>>(&mut self, cells: impl IntoIterator<Item = C>) {
        self.table.add_row(cells.into_iter().map(Into::into).collect::<Vec<Cell>>());
    }

    /// Returns its lines as printed.
    pub fn lines(&self) -> Vec<String> {
        let mut table = self.table.clone();
        // A text that is shorter takes no more room than it has.
        let contents = table.column_max_content_widths();
        for (column, content) in table.column_iter_mut().zip(contents) {
            if column.constraint() == Some(&TEXT) && content < MIN_TEXT {
                column.set_constraint(ColumnConstraint::ContentWidth);
            }
        }
        self.drop_columns(&mut table);
        table.lines().map(|row| row.trim_end().to_owned()).collect()
    }

    /// Hides optional columns until the others fit.
    fn drop_columns(&self, table: &mut comfy_table::Table) {
        let Some(width) = self.width.map(usize::from) else { return };
        let least = |content: u16, column: &comfy_table::Column| match column.constraint() {
            Some(constraint) if *constraint == TEXT => usize::from(MIN_TEXT),
            _ => usize::from(content),
        };
        let contents = table.column_max_content_widths();
        // Two blanks between columns.
        let taken = contents.iter().zip(table.column_iter()).map(|(content, column)| least(*content, column) + 2);
        let mut taken: Vec<usize> = taken.collect();
        for (at, _) in self.optional.iter().enumerate().rev().filter(|(_, optional)| **optional) {
            if taken.iter().sum::<usize>() <= width + 2 {
                return;
            }
            if let (Some(column), Some(taken)) = (table.column_mut(at), taken.get_mut(at)) {
                column.set_constraint(ColumnConstraint::Hidden);
                *taken = 0;
            }
        }
    }

    /// Prints it to stdout.
    pub fn print(&self) {
        self.lines().iter().for_each(line);
    }
}

/// Returns the last line of a check without errors.
pub fn no_mistakes(warnings: usize) -> String {
    match warnings {
        0 => "no mistakes".to_owned(),
        1 => "no mistakes, 1 warning".to_owned(),
        more => format!("no mistakes, {more} warnings"),
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

/// Formats a difference with its sign: `+0.50`, `-0.50`, `0.00`.
pub fn signed(value: f64, decimals: usize) -> String {
    let text = fixed(value, decimals);
    let plus = !text.starts_with('-') && text.bytes().any(|digit| matches!(digit, b'1'..=b'9'));
    if plus { format!("+{text}") } else { text }
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
        assert_eq!(columns(&terminal), None, "a new one has no size");
        for (width, usable) in [(80, Some(80)), (1, None), (0, None)] {
            tcsetwinsize(&terminal, Winsize { ws_row: 24, ws_col: width, ws_xpixel: 0, ws_ypixel: 0 }).unwrap();
            assert_eq!(columns(&terminal), usable, "{width}");
        }
        assert_eq!(columns(std::fs::File::open("/dev/null").unwrap()), None);
    }

    #[test]
    fn a_difference_has_its_sign_and_nothing_has_none() {
        assert_eq!([0.5, -0.5, 0.0, -0.004].map(|value| signed(value, 2)), ["+0.50", "-0.50", "0.00", "0.00"]);
    }

    #[test]
    fn a_long_sentence_is_broken_at_blanks_and_indented() {
        let text = "  arm: inputs: di0=1 di1=1 and µ of all sorts";
        assert_eq!(folded(text, None), [text]);
        assert_eq!(folded(text, Some(80)), [text]);
        assert_eq!(folded(text, Some(20)), ["  arm: inputs: di0=1", "    di1=1 and µ of", "    all sorts"]);
        assert_eq!(folded("a /a/path/without/any/blanks b", Some(20)), ["a", "  /a/path/without/any/blanks", "  b"]);
    }

    #[test]
    fn a_narrow_table_wraps_texts_and_keeps_names_whole() {
        let mut table = Table::of_width(&["NAME", "~ARMS", "~DESCRIPTION"], Some(80));
        table.row([
            "keyboard-teleop-xarm6",
            "left_arm (xarm, 7 joints), right_arm (xarm, 6 joints)",
            "a text of several words",
        ]);
        let lines = table.lines();
        assert!(lines.len() > 2 && lines.iter().all(|line| line.chars().count() <= 80), "{lines:?}");
        let words: Vec<&str> = lines.iter().flat_map(|line| line.split_whitespace()).collect();
        for word in ["keyboard-teleop-xarm6", "right_arm", "several"] {
            assert!(words.contains(&word), "{word} in {lines:?}");
        }
        let mut names = Table::of_width(&["JOINT", "ADDRESS"], Some(40));
        names.row(["left_arm_joint1", "INTERFACE|slcan:/dev/ttyX[@BITRATE]"]);
        assert_eq!(names.lines()[1], "left_arm_joint1  INTERFACE|slcan:/dev/ttyX[@BITRATE]", "wider than the terminal");
        let joints = |width| {
            let mut table = Table::of_width(&["JOINT", ">rad", ">?rad/s", "~TEXT", "?LAST"], Some(width));
            table.row(["left_arm_joint1", "0.5000", "0.2500", "a few words of a text that may wrap", "12 characters"]);
            table.lines()[0].split_whitespace().map(str::to_owned).collect::<Vec<_>>().join(" ")
        };
        assert_eq!(joints(74), "JOINT rad rad/s TEXT LAST");
        assert_eq!(joints(67), "JOINT rad rad/s TEXT");
        assert_eq!(joints(50), "JOINT rad TEXT", "no column but the optional ones is left out");
    }
}
