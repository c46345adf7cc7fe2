//! `dimos completions SHELL`: shell completions of verbs and options.

use std::io::{self, Write};

use clap_complete::Shell;

use super::exit::{Exit, Result};

/// Arguments of `completions`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
bash:  dimos completions bash > ~/.local/share/bash-completion/completions/dimos
zsh:   dimos completions zsh > a folder of $fpath, as _dimos
fish:  dimos completions fish > ~/.config/fish/completions/dimos.fish")]
pub struct Args {
    /// The shell
    shell: Shell,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let mut text = Vec::new();
    clap_complete::generate(args.shell, &mut super::command(), "dimos", &mut text);
    // A closed pipe is not an error.
    let _ = io::stdout().lock().write_all(&text);
    Ok(Exit::Ok)
}
