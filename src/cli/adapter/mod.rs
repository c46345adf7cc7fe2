//! `dimos adapter new|test|replay|emulate`: the integration kit.

pub(super) mod choice;
pub mod emulate;
mod first_day;
pub mod new;
mod peripheral;
pub mod replay;
mod report;
pub mod test;

use clap::Subcommand;

use super::exit::Result;
use dimos_hardware::registry::Registry;

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
    /// Check an adapter on a real arm, without motion unless allowed, or on its emulator
    Test(test::Args),
    /// Play the report of a first day: what the arm sent through the decoder, what was sent to it to the emulator
    Replay(replay::Args),
    /// Run an arm's emulator in its own process, until Ctrl-C
    Emulate(emulate::Args),
}

/// Runs the verb.
pub fn run(args: &Args, registry: &Registry) -> Result {
    match &args.action {
        Action::New(args) => new::run(args, registry),
        Action::Test(args) => test::run(args, registry),
        Action::Replay(args) => replay::run(args, registry),
        Action::Emulate(args) => emulate::run(args, registry),
    }
}
