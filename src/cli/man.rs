//! `dimos man`: the manual pages.

use std::io::{self, Write};
use std::path::PathBuf;

use anyhow::Context;

use super::exit::{Exit, Result};
use super::output;

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

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let command = super::command();
    let Some(dir) = &args.dir else {
        let mut page = Vec::new();
        let rendered = clap_mangen::Man::new(command).render(&mut page);
        rendered.context("cannot render the manual page")?;
        // A closed pipe is not an error.
        let _ = io::stdout().lock().write_all(&page);
        return Ok(Exit::Ok);
    };
    let pages = std::fs::create_dir_all(dir).and_then(|()| clap_mangen::generate_to(command, dir));
    pages.with_context(|| dir.display().to_string())?;
    output::note(format_args!("pages are in {}", dir.display()));
    Ok(Exit::Ok)
}
