//! The command line: one file per verb. stdout is data, stderr is diagnostics; exit codes are a contract ([`exit`]).

pub mod arguments;
pub mod arm;
pub mod banner;
pub mod cancel;
pub mod down;
pub mod execute;
pub mod exit;
mod follow;
pub mod list_adapters;
pub mod move_to;
pub mod output;
pub mod run;
pub mod state;
pub mod status;
pub mod stop;
mod trajectory_file;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

use crate::hardware::registry::{AdapterSpec, Registry};

const AFTER_HELP: &str = "\
Start with:  dimos run coordinator-yourarm
Then, in a second terminal:  dimos status, dimos state, dimos move arm 0.3 -0.2 0.5 0 0.4 0

Exit codes: 0 done, 1 failed or refused, 2 usage or blueprint wrong, 3 hardware unreachable, 4 a run ended by a fault,
130 and 143 ended by SIGINT and SIGTERM after the controlled stop.

`stop` is an operational stop and no safety function: use the arm's own rated stop where people can come to harm.";

#[derive(Debug, Parser)]
#[command(name = "dimos", version = crate::VERSION, about = "Runs robot arms from a blueprint", after_help = AFTER_HELP)]
#[command(propagate_version = true, arg_required_else_help = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Show all runs, or one in full: arms, tasks, timing, faults
    Status(status::Args),
    /// Show the joints of a run, and gripper, pose, force where there are such
    State(state::Args),
    /// Move an arm to joint positions, and wait until it is there
    Move(move_to::Args),
    /// Follow a trajectory from a file (JSON or CSV), and wait for its end
    Execute(execute::Args),
    /// End running motions by decelerating
    Cancel(cancel::Args),
    /// Hold arms at once and keep them held until `arm reset`: an operational stop
    Stop(stop::Args),
    /// Enable, disable or reset an arm, or move its gripper
    Arm(arm::Args),
    /// End a run, controlled: decelerate, release the arms, close the log
    Down(down::Args),
    /// List the arms that this program can talk to
    ListAdapters(list_adapters::Args),
}

/// Runs the command line, with more adapters than those in the box. What `main` of an embedding program calls.
pub fn main_with(adapters: &[AdapterSpec]) -> ExitCode {
    // Usage errors, `--help` and `--version` end here, with 2 or 0.
    let cli = Cli::parse();
    let registry = Registry::with(adapters);
    let result = match &cli.command {
        Command::Status(args) => status::run(args),
        Command::State(args) => state::run(args),
        Command::Move(args) => move_to::run(args),
        Command::Execute(args) => execute::run(args),
        Command::Cancel(args) => cancel::run(args),
        Command::Stop(args) => stop::run(args),
        Command::Arm(args) => arm::run(args),
        Command::Down(args) => down::run(args),
        Command::ListAdapters(args) => list_adapters::run(args, &registry),
    };
    let exit = result.unwrap_or_else(|failure| {
        output::failure(&failure);
        failure.exit
    });
    ExitCode::from(exit as u8)
}
