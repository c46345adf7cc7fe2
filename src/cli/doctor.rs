//! `dimos doctor`: what this computer grants a run, and the command that changes what it does not.

mod host;

use serde::Serialize;

use super::exit::{Exit, Failure, Result};
use super::output::{self, Table, Tone, toned};

/// Arguments of `doctor`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
warn: a run works without it, but keeps its time less well, or lacks something. Exit code 1 only where something
prevents a run.")]
pub struct Args {
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// How grave a finding is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum Level {
    /// As it should be.
    Ok,
    /// A run works, but less well.
    Warn,
    /// No run can work.
    Bad,
}

/// One thing that was looked at.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
struct Finding {
    check: &'static str,
    level: Level,
    /// What was found.
    found: String,
    /// The command that changes it.
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
            let failure = Failure::new(Exit::Failed, format!("no run can work: {}", finding.found));
            Err(finding.fix.iter().fold(failure, |failure, fix| failure.hint(fix.clone())))
        }
    }
}

fn print(findings: &[Finding]) {
    let mut table = Table::new(&["CHECK", "", "FOUND"]);
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
