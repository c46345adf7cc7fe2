//! All of dimos, with one arm more.

use std::process::ExitCode;

use dimos::cli::Program;

fn main() -> ExitCode {
    Program::new()
        .adapter(acme::SPEC)
        .blueprint("coordinator-acme", include_str!("../blueprints/coordinator-acme.yaml"))
        .blueprint("acme-planner", include_str!("../blueprints/acme-planner.yaml"))
        .robot("acme", include_str!("../robots/acme.urdf"))
        .main()
}
