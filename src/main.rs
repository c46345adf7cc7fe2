//! The program: the command line with the arms in the box.

use std::process::ExitCode;

fn main() -> ExitCode {
    dimos::cli::main_with(&[])
}
