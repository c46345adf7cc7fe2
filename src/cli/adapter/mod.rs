//! `dimos adapter new`: the integration kit.

pub mod new;

use clap::Subcommand;

use super::exit::Result;
use crate::hardware::registry::Registry;

/// Arguments of `adapter`.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Write the start of an adapter for a new arm: it compiles, passes the conformance suite, and runs simulated
    New(new::Args),
}

/// Runs the verb.
pub fn run(args: &Args, registry: &Registry) -> Result {
    match &args.action {
        Action::New(args) => new::run(args, registry),
    }
}
