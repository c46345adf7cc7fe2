//! `dimos adapter replay FILE`: what an arm did on its first day becomes a test.

use std::io::{self, IsTerminal};
use std::path::PathBuf;

use indicatif::{ProgressBar, ProgressStyle};

use super::super::exit::{Exit, Failure, Result};
use super::super::follow::Signals;
use super::super::output::{self, Table};
use dimos_hardware::conformance::first_day::replay::{Comparison, replay};
use dimos_hardware::conformance::first_day::report::Report;
use dimos_hardware::registry::Registry;

/// Arguments of `adapter replay`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
The file is the report of `dimos adapter test NAME --first-day --report FILE`. Every message that the arm sent is decoded by the \
adapter's decoder. What was sent to the arm is sent to its emulator, as fast as then, except while things went wrong on purpose; the \
emulator's messages must be of the same kinds as the arm's.

Exit codes: 0 no difference, 1 differences, 2 the file cannot be read.")]
pub struct Args {
    /// The report
    pub file: PathBuf,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// Runs the verb.
pub fn run(args: &Args, registry: &Registry) -> Result {
    let wrong = |what: String| Failure::usage(format!("{}: {what}", args.file.display()));
    let (report, chunks) = Report::read(&args.file).map_err(wrong)?;
    let Some(row) = registry.get(&report.adapter) else {
        return Err(wrong(format!("this program has no adapter {}", report.adapter)));
    };
    if row.wire.is_none() || row.emulate.is_none() {
        return Err(wrong(format!("{} has no emulator, or no messages to compare", row.name)));
    }
    let signals = Signals::watch();
    let bar = if args.json || !io::stderr().is_terminal() { ProgressBar::hidden() } else { ProgressBar::new(100) };
    if let Ok(style) = ProgressStyle::with_template("[{bar:30}] {pos} %") {
        bar.set_style(style.progress_chars("=> "));
    }
    let interrupted = || signals.last().is_some();
    let comparison = replay(&report, &chunks, row, &mut |part| bar.set_position((100.0 * part) as u64), &interrupted)
        .map_err(|e| Failure::of(Exit::Failed, e))?;
    bar.finish_and_clear();
    if let Some(signal) = signals.last() {
        return Ok(Exit::by_signal(signal));
    }
    if args.json {
        output::json(&comparison);
    } else {
        print(&report, &comparison);
    }
    match comparison.same() {
        true => Ok(Exit::Ok),
        false => Err(Failure::new(Exit::Failed, "the emulator differs from the arm, or the decoder does not take it")),
    }
}

fn print(report: &Report, comparison: &Comparison) {
    let firmware = report.firmware.as_deref().unwrap_or("not reported");
    output::line(format_args!("{} {}, firmware {firmware}, {}", report.vendor, report.model, report.when));
    let mut table = Table::new(&["MESSAGE", ">ARM", ">EMULATOR", "DIFFERENCE"]);
    for (name, kind) in &comparison.kinds {
        let difference = kind.difference.as_deref().unwrap_or_default();
        table.row([name.as_str(), &kind.arm.to_string(), &kind.emulator.to_string(), difference]);
    }
    table.print();
    let (damaged, all) = comparison.damaged;
    output::line(format_args!("{damaged} of {all} bytes from the arm are no message"));
    comparison.differences.iter().for_each(output::line);
}
