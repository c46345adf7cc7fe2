//! The program: the command line with the built-in arms.

use std::process::ExitCode;

fn main() -> ExitCode {
    dimos::cli::main_with(&[])
}
