//! `dimos completions SHELL`: the script by which a shell asks this program for completions
//! ([`complete`](super::complete)).

use anyhow::Context;
use clap_complete::Shell;
use clap_complete::env::Shells;

use super::complete::VARIABLE;
use super::exit::{Exit, Failure, Result};
use super::output;

/// Arguments of `completions`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
At each Tab the shell asks this program, so that blueprints, live runs, arms, tasks, named poses and adapters are offered.

bash:  dimos completions bash \\
         > ~/.local/share/bash-completion/completions/dimos
zsh:   dimos completions zsh > a folder of $fpath, as _dimos
fish:  dimos completions fish > ~/.config/fish/completions/dimos.fish")]
pub struct Args {
    /// The shell
    shell: Shell,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let name = args.shell.to_string();
    let shells = Shells::builtins();
    let shell = shells.completer(&name).ok_or_else(|| Failure::usage(format!("no completions for {name}")))?;
    let program = program();
    let mut text = Vec::new();
    shell.write_registration(VARIABLE, &program, &program, &program, &mut text).context("cannot print the script")?;
    output::data(&text);
    Ok(Exit::Ok)
}

/// Returns the name by which this program is called: one that embeds it has another.
fn program() -> String {
    let called = std::env::args_os().next().unwrap_or_default();
    let name = std::path::Path::new(&called).file_name().map(|name| name.to_string_lossy().into_owned());
    name.unwrap_or_else(|| "dimos".to_owned())
}
