//! A bar for what reads a whole log.

use std::io::{self, IsTerminal};

use indicatif::{ProgressBar, ProgressFinish, ProgressStyle};

use dimos_log::scan::Scan;

/// Returns what shows how much of how much is read: a bar on standard error, if that is a terminal, which disappears at
/// the end. What prints as it reads has none where it prints to the terminal as well.
pub fn bar(prints: bool) -> impl FnMut(u64, u64) {
    let shown = io::stderr().is_terminal() && !(prints && io::stdout().is_terminal());
    let bar = if shown { ProgressBar::new(1) } else { ProgressBar::hidden() };
    let bar = bar.with_finish(ProgressFinish::AndClear);
    if let Ok(style) = ProgressStyle::with_template("[{bar:40}] {percent:>3} %") {
        bar.set_style(style.progress_chars("=> "));
    }
    move |read: u64, length: u64| {
        bar.set_length(length);
        bar.set_position(read);
    }
}

/// Returns the same for a log that is read record by record.
pub fn of_scan(prints: bool) -> impl FnMut(&Scan) {
    let mut bar = bar(prints);
    move |scan| {
        let (read, length) = scan.position();
        bar(read, length);
    }
}
