//! The program: the command line with the built-in arms.

#![forbid(unsafe_code)]

use std::process::ExitCode;

fn main() -> ExitCode {
    dimos::cli::main_with(&[])
}
