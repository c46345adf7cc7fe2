//! Python tools that tests ask: used where they are installed, else said.

use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};

use super::skip::skip_tool;

/// What a script of `tests/readers` says to some JSON; nothing where its Python packages are not installed.
pub fn ask_python(script: &str, module: &str, question: &serde_json::Value) -> Option<serde_json::Value> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python = root.join(".venv/bin/python");
    let has = Command::new(&python).args(["-c", &format!("import {module}")]).stderr(Stdio::null()).status();
    if !has.is_ok_and(|s| s.success()) {
        skip_tool(&format!("Python's {module}"));
        return None;
    }
    let script = root.join("tests/readers").join(script);
    let mut child = Command::new(python).arg(script).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let mut input = child.stdin.take().unwrap();
    let text = question.to_string();
    let writer = std::thread::spawn(move || input.write_all(text.as_bytes()).unwrap());
    let output = child.wait_with_output().unwrap();
    writer.join().unwrap();
    assert!(output.status.success(), "the script failed");
    Some(serde_json::from_slice(&output.stdout).unwrap())
}
