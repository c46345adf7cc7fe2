//! The page of the live view in a real browser (`viewer/tests`): what it shows, and what its clicks do to a run.

use std::path::Path;
use std::process::{Command, Stdio};

use crate::support::skip::{skip, skip_tool};

#[test]
fn the_page_works_in_a_browser() {
    in_a_browser("page.mjs");
}

#[test]
fn logs_models_and_blueprints_are_shown_in_a_browser() {
    in_a_browser("files.mjs");
}

/// With `DIMOS_PAGE_SOAK` (minutes) the same acts repeatedly, while nothing may grow.
#[test]
fn the_page_jogs_teaches_and_moves_several_arms() {
    in_a_browser(if std::env::var_os("DIMOS_PAGE_SOAK").is_some() { "soak.mjs" } else { "acts.mjs" });
}

fn in_a_browser(file: &str) {
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
        .args(["--test", &format!("tests/{file}")])
        .current_dir(viewer)
        .env("DIMOS", env!("CARGO_BIN_EXE_dimos"))
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    println!("{text}");
    assert!(output.status.success(), "{text}\n{}", String::from_utf8_lossy(&output.stderr));
}
