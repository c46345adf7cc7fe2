//! The lines that a run prints for people, kept for clients: `text_log`. Local programs have the file of a run without
//! a terminal; those on other computers have this.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use dimos_core::clock::wall_now;
use dimos_core::sync::lock;

/// Lines that are kept.
const KEPT: usize = 1000;
/// Maximum number of lines in a reply.
const PER_REPLY: usize = 256;
/// Maximum length of a line that is kept [characters]; the rest is cut off.
const MAX_LENGTH: usize = 2000;

/// Parameters of `text_log`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TextLog {
    /// Number of the last line that the client has; 0: none.
    #[serde(default)]
    pub after: u64,
}

/// Reply to `text_log`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct TextLogReport {
    /// Identifies the log: that of another run, with other line numbers, has another one.
    pub log: u64,
    /// Number of the last of these lines; without lines, `after`.
    pub last: u64,
    /// Lines that are too old to be kept, just before these.
    pub lost: u64,
    /// The lines after it, at most 256.
    pub lines: Vec<String>,
}

/// The latest lines of a run. Shared by the one who prints them and the one who answers requests.
#[derive(Debug, Clone)]
pub struct TextLines {
    log: u64,
    kept: Arc<Mutex<Kept>>,
}

impl Default for TextLines {
    fn default() -> Self {
        Self { log: wall_now() / 1000, kept: Arc::default() }
    }
}

#[derive(Debug, Default)]
struct Kept {
    /// Number of the last line.
    last: u64,
    lines: VecDeque<String>,
}

impl TextLines {
    /// Adds the lines of a text, without colours and other control sequences.
    pub fn push(&self, text: &str) {
        let mut kept = lock(&self.kept);
        for line in text.lines() {
            if kept.lines.len() == KEPT {
                kept.lines.pop_front();
            }
            kept.lines.push_back(plain(line));
            kept.last += 1;
        }
    }

    /// Returns the lines after the one with this number. A number that is not reached yet is that of another run: then
    /// all of them.
    pub fn after(&self, after: u64) -> TextLogReport {
        let kept = lock(&self.kept);
        let first = kept.last - kept.lines.len() as u64;
        let after = if after > kept.last { 0 } else { after };
        let skip = after.saturating_sub(first) as usize;
        let lines: Vec<String> = kept.lines.iter().skip(skip).take(PER_REPLY).cloned().collect();
        let (lost, last) = (first.saturating_sub(after), first.max(after) + lines.len() as u64);
        TextLogReport { log: self.log, last, lost, lines }
    }
}

/// Returns a line without the control sequences of terminals.
fn plain(line: &str) -> String {
    let (mut text, mut characters) = (String::with_capacity(line.len()), line.chars());
    while let Some(c) = characters.next() {
        match c {
            // ESC [ … letter
            '\x1b' => drop(characters.by_ref().find(|c| c.is_ascii_alphabetic())),
            '\t' => text.push(' '),
            c if c.is_control() => {}
            c => text.push(c),
        }
    }
    match text.char_indices().nth(MAX_LENGTH) {
        Some((end, _)) => text.get(..end).unwrap_or_default().to_owned() + "…",
        None => text,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reader_gets_each_line_once_and_is_told_what_it_missed() {
        let text = TextLines::default();
        assert_eq!((text.after(0).last, text.after(0).lines.len()), (0, 0));
        text.push("\x1b[1mrun cell\x1b[0m\n\x1b[33m WARN\x1b[0m late\n");
        let first = text.after(0);
        assert_eq!((first.lines, first.last, first.lost), (vec!["run cell".to_owned(), " WARN late".to_owned()], 2, 0));
        assert_eq!(text.after(2).last, 2);
        text.push("more");
        assert_eq!((text.after(2).lines, text.after(2).last), (vec!["more".to_owned()], 3));
        // Numbers of another run.
        assert_eq!(text.after(77).lines.len(), 3);

        (4..=2 * KEPT as u64).for_each(|n| text.push(&n.to_string()));
        let (mut seen, mut after, mut lost) = (Vec::new(), 3, 0);
        loop {
            let report = text.after(after);
            (after, lost) = (report.last, lost + report.lost);
            if report.lines.is_empty() {
                break;
            }
            seen.extend(report.lines);
        }
        assert_eq!((seen.len(), lost, after), (KEPT, KEPT as u64 - 3, 2 * KEPT as u64));
        assert_eq!((seen.first().unwrap().as_str(), seen.last().unwrap().as_str()), ("1001", "2000"));
    }

    #[test]
    fn a_long_line_is_cut() {
        assert_eq!(plain(&"ä".repeat(3000)).chars().count(), MAX_LENGTH + 1);
    }
}
