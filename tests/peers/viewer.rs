//! The page of the live view in a real browser (`viewer/tests`): what it shows, and what its clicks do to a run.

use std::path::Path;
use std::process::{Command, Stdio};

use crate::support::skip::{skip, skip_tool};

#[test]
fn the_page_works_in_a_browser() {
    in_a_browser("tests/page.mjs");
}

#[test]
fn logs_models_and_blueprints_are_shown_in_a_browser() {
    in_a_browser("tests/files.mjs");
}

fn in_a_browser(tests: &str) {
    let viewer = Path::new(env!("CARGO_MANIFEST_DIR")).join("viewer");
    let has =
        |tool: &str| Command::new(tool).arg("--version").stdout(Stdio::null()).status().is_ok_and(|s| s.success());
    if !viewer.join("dist/index.html").exists() {
        return skip("the page of the live view (make viewer)");
    }
    if !has("node") || !has("/usr/bin/chromium") || !viewer.join("node_modules/playwright-core").exists() {
        return skip_tool("Node, Chromium and its driver");
    }
    let output = Command::new("node")
        .args(["--test", tests])
        .current_dir(viewer)
        .env("DIMOS", env!("CARGO_BIN_EXE_dimos"))
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    println!("{text}");
    assert!(output.status.success(), "{text}\n{}", String::from_utf8_lossy(&output.stderr));
}
