//! `dimos man`: the manual, as pages for `man`.

use std::io::{self, Write};
use std::path::PathBuf;

use super::exit::{Exit, Failure, Result};
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
        rendered.map_err(|e| Failure::new(Exit::Failed, e.to_string()))?;
        // That nobody reads it is no error.
        let _ = io::stdout().lock().write_all(&page);
        return Ok(Exit::Ok);
    };
    let failed = |e: io::Error| Failure::new(Exit::Failed, format!("{}: {e}", dir.display()));
    std::fs::create_dir_all(dir).map_err(failed)?;
    clap_mangen::generate_to(command, dir).map_err(failed)?;
    output::note(format_args!("pages are in {}", dir.display()));
    Ok(Exit::Ok)
}
