//! `dimos man`: the manual pages. Each has the sections that manual pages are read for: examples, exit status, files,
//! environment.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Command;
use clap_mangen::Man;
use clap_mangen::roff::{Roff, bold, roman};

use super::exit::{Exit, Result};
use super::output;

mod examples;

/// Arguments of `man`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Read it:       dimos man | man -l -
Install it:    dimos man --dir ~/.local/share/man/man1")]
pub struct Args {
    /// Write one page per verb into this folder, instead of the first page to stdout
    #[arg(long, value_name = "FOLDER")]
    dir: Option<PathBuf>,
}

/// Examples of the first page.
const EXAMPLES: &[(&str, &str)] = &[
    ("dimos run coordinator-yourarm", "a simulated arm; in a second terminal:"),
    ("dimos status", "arms, tasks, timing, faults"),
    ("dimos move arm 0.3 -0.2 0.5 0 0.4 0", "one position per joint [rad]"),
    ("dimos stop", "an operational stop of all arms"),
    ("dimos run xarm6-planner --address arm=192.168.1.185", "a real arm, with a planner"),
    ("dimos plan arm --named home; dimos preview; dimos execute", "plan, look, move"),
    ("dimos run -d NAME; dimos logs -f; dimos down", "a run in the background"),
    ("dimos status --json", "for programs; an error is {\"error\": {\"code\", \"message\", \"hint\", \"data\"}}"),
];

/// Files that the program reads and writes.
const FILES: &[(&str, &str)] = &[
    ("$XDG_RUNTIME_DIR/dimos/RUN.sock", "socket of a live run; without the variable in /tmp/dimos-UID"),
    ("$XDG_STATE_HOME/dimos/RUN-TIME.mcap", "log of a run; ~/.local/state without the variable"),
    ("$XDG_STATE_HOME/dimos/RUN-TIME.log", "text log of a run that was started with --daemon"),
    ("$XDG_STATE_HOME/dimos/RUN.json", "record of the latest run of that name: how it ended"),
    ("$XDG_CACHE_HOME/dimos", "downloaded robot descriptions, proofs about links; ~/.cache without the variable"),
    ("$XDG_CONFIG_HOME/dimos/places.yaml", "names of places on other computers, for --at"),
    ("./blueprints, $XDG_CONFIG_HOME/dimos/blueprints", "blueprints that are run by name"),
];

/// Environment variables that the program reads.
const ENVIRONMENT: &[(&str, &str)] = &[
    ("DIMOS_AT", "place whose runs the verbs talk to, as --at"),
    ("DIMOS_IDENTITY", "folder of the certificates that this computer shows a place"),
    ("DIMOS_BLUEPRINT_PATH", "further folders with blueprints, separated by colons"),
    ("DIMOS_LOG", "level of the text log: error, warn (default), info, debug"),
    ("NO_COLOR", "if set and not empty: no colours"),
    (
        "DIMOS_WORLD",
        "folder of a closed world of runs, for tests: it takes only arms at sim, loopback and pseudo-terminals",
    ),
    ("XDG_RUNTIME_DIR, XDG_STATE_HOME, XDG_CACHE_HOME, XDG_CONFIG_HOME", "folders, see FILES"),
];

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let mut command = super::command().disable_help_subcommand(true);
    command.build();
    let Some(dir) = &args.dir else {
        let page = page(&command, "").context("cannot render the manual page")?;
        output::data(&page);
        return Ok(Exit::Ok);
    };
    let pages = fs::create_dir_all(dir).and_then(|()| write_pages(&command, dir, ""));
    pages.with_context(|| dir.display().to_string())?;
    output::note(format_args!("pages are in {}", dir.display()));
    Ok(Exit::Ok)
}

/// Writes the page of a verb and those of the verbs below it.
fn write_pages(command: &Command, dir: &Path, path: &str) -> io::Result<()> {
    fs::write(dir.join(Man::new(command.clone()).get_filename()), page(command, path)?)?;
    let verbs = command.get_subcommands().filter(|verb| !verb.is_hide_set());
    verbs.into_iter().try_for_each(|verb| write_pages(verb, dir, format!("{path} {}", verb.get_name()).trim_start()))
}

/// Returns the page of the verb at `path`; empty: the first page.
fn page(command: &Command, path: &str) -> io::Result<Vec<u8>> {
    let is_first = path.is_empty();
    let man = Man::new(command.clone());
    let mut page = Vec::new();
    man.render_title(&mut page)?;
    man.render_name_section(&mut page)?;
    synopsis(command).to_writer(&mut page)?;
    man.render_description_section(&mut page)?;
    if command.get_arguments().any(|arg| !arg.is_hide_set()) {
        man.render_options_section(&mut page)?;
    }
    if command.has_subcommands() {
        man.render_subcommands_section(&mut page)?;
    }
    let mut roff = Roff::default();
    let epilogue = command.get_after_long_help().or(command.get_after_help());
    // The epilogue of the first page repeats its sections.
    let epilogue = epilogue.filter(|_| !is_first).map(ToString::to_string).unwrap_or_default();
    let more = examples::OF_VERBS.iter().find(|(verb, _)| *verb == path).map_or(&[][..], |(_, examples)| examples);
    notes(&mut roff, &epilogue, more);
    if is_first {
        table(&mut roff, "EXAMPLES", EXAMPLES);
    }
    let codes: Vec<_> = Exit::ALL.iter().map(|(exit, meaning)| ((*exit as u8).to_string(), *meaning)).collect();
    table(&mut roff, "EXIT STATUS", &codes.iter().map(|(code, meaning)| (code.as_str(), *meaning)).collect::<Vec<_>>());
    table(&mut roff, "FILES", FILES);
    table(&mut roff, "ENVIRONMENT", ENVIRONMENT);
    roff.to_writer(&mut page)?;
    if is_first {
        man.render_version_section(&mut page)?;
    }
    Ok(page)
}

/// Returns the usage lines of the help, which name the values of options and arguments.
fn synopsis(command: &Command) -> Roff {
    let mut roff = Roff::default();
    roff.control("SH", ["SYNOPSIS"]);
    let usage = command.clone().term_width(0).render_usage().to_string();
    for line in usage.trim_start_matches("Usage:").lines() {
        roff.text([bold(line.trim())]).control("br", []);
    }
    roff
}

/// Adds an epilogue, and further examples: examples are its indented lines, notes everything else.
fn notes(roff: &mut Roff, epilogue: &str, more: &[&str]) {
    let (mut examples, notes): (Vec<&str>, Vec<&str>) = epilogue.lines().partition(|line| line.starts_with("  dimos "));
    if notes.iter().any(|line| !line.trim().is_empty()) {
        roff.control("SH", ["NOTES"]);
        for line in notes {
            match line.trim() {
                "" => roff.control("PP", []),
                text if line.starts_with(' ') => roff.control("br", []).text([roman(text)]),
                text => roff.text([roman(text)]).control("br", []),
            };
        }
    }
    examples.extend(more);
    if !examples.is_empty() {
        roff.control("SH", ["EXAMPLES"]);
        for line in examples {
            roff.text([bold(line.trim())]).control("br", []);
        }
    }
}

fn table(roff: &mut Roff, title: &str, rows: &[(&str, &str)]) {
    roff.control("SH", [title]);
    for (name, meaning) in rows {
        roff.control("TP", []).text([bold(*name)]).text([roman(*meaning)]);
    }
}
