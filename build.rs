//! What the build tells the program.

use std::path::Path;
use std::process::Command;

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    version();
}

/// Sets `DIMOS_VERSION`: the package's version, with the commit where there is one: `0.1.0 (1d8ac97f)`.
fn version() {
    let git = |arguments: &[&str]| {
        let output = Command::new("git").args(arguments).output().ok()?;
        let text = String::from_utf8(output.stdout).ok()?.trim().to_owned();
        (output.status.success() && !text.is_empty()).then_some(text)
    };
    let package = env!("CARGO_PKG_VERSION");
    match git(&["rev-parse", "--short=8", "HEAD"]) {
        Some(commit) => println!("cargo::rustc-env=DIMOS_VERSION={package} ({commit})"),
        None => println!("cargo::rustc-env=DIMOS_VERSION={package}"),
    }
    // Each commit, checkout and reset adds a line to this file.
    if let Some(log) = git(&["rev-parse", "--git-path", "logs/HEAD"]).filter(|path| Path::new(path).exists()) {
        println!("cargo::rerun-if-changed={log}");
    }
}
