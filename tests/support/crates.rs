//! Builds crates that use this checkout with what is built for this test. Cargo takes a build for the same if package,
//! version, features and profile are, and the path from the root of the workspace: so a crate and a copy of the
//! checkout's manifest, beside links to its sources, are made one workspace. Nothing of dimos is compiled again.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;

use rustix::fs::{AtFlags, CWD, Timespec, Timestamps, utimensat};

/// The checkout that is tested.
pub const CHECKOUT: &str = env!("CARGO_MANIFEST_DIR");
/// What cargo reads of it.
const SOURCES: [&str; 10] =
    ["assets", "benches", "blueprints", "build.rs", "crates", "fuzz", "src", "tests", "viewer", ".git"];

/// The folder of the programs that cargo builds for this test.
pub fn programs() -> PathBuf {
    Path::new(env!("CARGO_BIN_EXE_dimos")).parent().unwrap().to_owned()
}

/// Lets the crate in a folder use what is built for this test; the folder above becomes the workspace. The same
/// versions and the same features of all libraries: Cargo.lock is the checkout's, and its development dependencies,
/// which enable features of others, are added to those of the crate.
pub fn share_builds(folder: &Path) {
    if folder.join("target").exists() {
        return;
    }
    let (checkout, root) = (Path::new(CHECKOUT), folder.parent().unwrap());
    // Cargo takes the time of a link for a change of the folder.
    let old = Timestamps { last_access: Timespec::default(), last_modification: Timespec { tv_sec: 1, tv_nsec: 0 } };
    for name in SOURCES {
        symlink(checkout.join(name), root.join(name)).unwrap();
        utimensat(CWD, root.join(name), &old, AtFlags::SYMLINK_NOFOLLOW).unwrap();
    }
    let target = programs().parent().unwrap().to_owned();
    symlink(&target, root.join("target")).unwrap();
    symlink(&target, folder.join("target")).unwrap();
    fs::copy(checkout.join("Cargo.lock"), root.join("Cargo.lock")).unwrap();
    let used = fs::read_to_string(checkout.join("Cargo.toml")).unwrap();
    let members = "members = [\"crates/*\"";
    assert!(used.contains(members), "{used}");
    let name = folder.file_name().unwrap().to_str().unwrap();
    let packages: Vec<_> =
        ["", "/program"].iter().filter(|at| folder.join(format!(".{at}/Cargo.toml")).exists()).collect();
    let added: String = packages.iter().map(|at| format!(", \"{name}{at}\"")).collect();
    fs::write(root.join("Cargo.toml"), used.replace(members, &format!("{members}{added}"))).unwrap();
    let used = used.split("[dev-dependencies]\n").nth(1).unwrap().split("\n[").next().unwrap();
    // What uses a part of dimos uses all of it here: the same features of all libraries, so the same builds.
    let features = if cfg!(feature = "share") { ", features = [\"share\"]" } else { "" };
    let real = fs::canonicalize(checkout).unwrap();
    for at in packages {
        let path = folder.join(format!(".{at}/Cargo.toml"));
        let up = if at.is_empty() { ".." } else { "../.." };
        let manifest = fs::read_to_string(&path).unwrap().replace("[workspace]\nmembers = [\"program\"]\n", "");
        let manifest =
            manifest.replace(&format!("path = \"{}/crates/", real.display()), &format!("path = \"{up}/crates/"));
        let manifest = manifest.replace(", default-features = false", "");
        let whole = format!("path = {real:?} }}");
        let all = format!("path = \"{up}\"{features} }}");
        let more = if manifest.contains(&whole) { String::new() } else { format!("dimos = {{ {all}\n") };
        assert_eq!(manifest.matches("[dependencies]\n").count(), 1, "{manifest}");
        let manifest = manifest.replace("[dependencies]\n", &format!("[dependencies]\n{}\n{more}", used.trim()));
        fs::write(path, manifest.replace(&whole, &all)).unwrap();
    }
}

/// Removes what the cargo that runs this test has set. With its `CARGO_PKG_NAME` or `OUT_DIR`, build scripts such as
/// ring's run again: dimos would be compiled again for each crate, and again by the next build of the checkout.
pub fn without_cargo_settings(command: &mut Command) -> &mut Command {
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("CARGO_") && name != "CARGO_HOME") {
        command.env_remove(name);
    }
    // As many jobs as the outer build may have, and builds of the same kind.
    for name in ["CARGO_BUILD_JOBS", "CARGO_INCREMENTAL"] {
        if let Some(value) = std::env::var_os(name) {
            command.env(name, value);
        }
    }
    command.env_remove("OUT_DIR").env("CARGO_NET_OFFLINE", "true")
}
