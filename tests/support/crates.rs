//! Builds crates that use this checkout, in its own `target` folder: what is built there already is used again, and
//! dimos itself is compiled once for all of them.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The checkout that is tested.
pub const CHECKOUT: &str = env!("CARGO_MANIFEST_DIR");

/// Only the code of these crates is of interest: dimos needs no debug information and is not compiled again.
const CONFIG: &str = "[build]\nincremental = false\n\n[profile.dev.package.dimos]\ndebug = false\n";

/// The folder of the programs that cargo builds for this test.
pub fn programs() -> PathBuf {
    Path::new(env!("CARGO_BIN_EXE_dimos")).parent().unwrap().to_owned()
}

/// Lets the crate in a folder use what is built for this test. The same versions and the same features of all
/// libraries: Cargo.lock is the checkout's, and its development dependencies, which enable features of others, are
/// added to those of the crate.
pub fn share_builds(folder: &Path) {
    if folder.join("target").exists() {
        return;
    }
    let checkout = Path::new(CHECKOUT);
    fs::copy(checkout.join("Cargo.lock"), folder.join("Cargo.lock")).unwrap();
    std::os::unix::fs::symlink(programs().parent().unwrap(), folder.join("target")).unwrap();
    fs::create_dir_all(folder.join(".cargo")).unwrap();
    fs::write(folder.join(".cargo/config.toml"), CONFIG).unwrap();
    let used = fs::read_to_string(checkout.join("Cargo.toml")).unwrap();
    let used = used.split("[dev-dependencies]\n").nth(1).unwrap().split("\n[").next().unwrap();
    let manifest = fs::read_to_string(folder.join("Cargo.toml")).unwrap();
    assert_eq!(manifest.matches("[dependencies]\n").count(), 1, "{manifest}");
    let manifest = manifest.replace("[dependencies]\n", &format!("[dependencies]\n{}\n", used.trim()));
    fs::write(folder.join("Cargo.toml"), manifest).unwrap();
}

/// Removes what the cargo that runs this test has set. With its `CARGO_PKG_NAME` or `OUT_DIR`, build scripts such as
/// ring's run again: dimos would be compiled again for each crate, and again by the next build of the checkout.
pub fn without_cargo_settings(command: &mut Command) -> &mut Command {
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("CARGO_") && name != "CARGO_HOME") {
        command.env_remove(name);
    }
    // As many jobs as the outer build may have.
    if let Some(jobs) = std::env::var_os("CARGO_BUILD_JOBS") {
        command.env("CARGO_BUILD_JOBS", jobs);
    }
    command.env_remove("OUT_DIR").env("CARGO_NET_OFFLINE", "true")
}
