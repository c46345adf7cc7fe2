//! `dimos doctor`: checks the real-time setup, permissions and devices, and prints a fix for each problem.

mod host;
mod installed;

use serde::Serialize;

use super::exit::{Exit, Failure, Result};
use super::output::{self, Table, Tone, toned};

/// Arguments of `doctor`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
warn: the run still works, with more timing jitter or without some feature. Exit code 1 only if runs cannot start.")]
pub struct Args {
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// Severity of a finding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum Level {
    /// No problem.
    Ok,
    /// Runs work, but with more jitter or without some feature.
    Warn,
    /// No run can work.
    Bad,
}

/// Result of one check.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
struct Finding {
    check: &'static str,
    level: Level,
    /// The observation.
    found: String,
    /// The command that fixes it.
    fix: Option<String>,
}

impl Finding {
    fn ok(check: &'static str, found: impl Into<String>) -> Self {
        Self { check, level: Level::Ok, found: found.into(), fix: None }
    }

    fn warn(check: &'static str, found: impl Into<String>, fix: impl Into<String>) -> Self {
        Self { check, level: Level::Warn, found: found.into(), fix: Some(fix.into()) }
    }

    fn bad(check: &'static str, found: impl Into<String>, fix: impl Into<String>) -> Self {
        Self { level: Level::Bad, ..Self::warn(check, found, fix) }
    }

    fn of(well: bool, check: &'static str, found: impl Into<String>, fix: impl Into<String>) -> Self {
        if well { Self::ok(check, found) } else { Self::warn(check, found, fix) }
    }
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let findings = host::Host::this().examine();
    if args.json {
        output::json(&findings);
    } else {
        print(&findings);
    }
    match findings.iter().find(|finding| finding.level == Level::Bad) {
        None => Ok(Exit::Ok),
        Some(finding) => {
            let failure = Failure::new(Exit::Failed, format!("runs cannot start: {}", finding.found));
            Err(finding.fix.iter().fold(failure, |failure, fix| failure.hint(fix.clone())))
        }
    }
}

fn print(findings: &[Finding]) {
    let mut table = Table::new(&["CHECK", "", "~FOUND"]);
    for finding in findings {
        let level = match finding.level {
            Level::Ok => toned("ok", Tone::Good),
            Level::Warn => toned("warn", Tone::Warning),
            Level::Bad => toned("BAD", Tone::Bad),
        };
        table.row([finding.check.into(), level, finding.found.as_str().into()]);
    }
    table.print();
    for finding in findings {
        if let Some(fix) = &finding.fix {
            output::line("");
            output::line(format_args!("{}: {}\n  {fix}", finding.check, finding.found));
        }
    }
}
