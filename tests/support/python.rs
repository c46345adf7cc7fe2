//! Python tools that tests ask: used where they are installed, else said.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use super::skip::skip_tool;

/// The Python that has these packages; nothing where they are not installed. They are not imported: that makes some
/// write to the home folder, and fail where several do so at once.
#[track_caller]
pub fn python_with(packages: &[&str]) -> Option<PathBuf> {
    let python = Path::new(env!("CARGO_MANIFEST_DIR")).join(".venv/bin/python");
    let find = "import importlib.util, sys; sys.exit(any(importlib.util.find_spec(p) is None for p in sys.argv[1:]))";
    let has = Command::new(&python).args(["-c", find]).args(packages).stderr(Stdio::null()).status();
    if !has.is_ok_and(|status| status.success()) {
        skip_tool(&format!("Python's {}", packages.join(", ")));
        return None;
    }
    Some(python)
}

/// What a script of `tests/readers` says to some JSON; nothing where its Python packages are not installed.
pub fn ask_python(script: &str, module: &str, question: &serde_json::Value) -> Option<serde_json::Value> {
    let python = python_with(&[module])?;
    Some(answer(&python, &Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/readers").join(script), question))
}

/// What a script of `tests/python` says to some JSON.
pub fn ask(python: &Path, script: &str, question: &serde_json::Value) -> serde_json::Value {
    answer(python, &Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python").join(script), question)
}

fn answer(python: &Path, script: &Path, question: &serde_json::Value) -> serde_json::Value {
    let mut child = Command::new(python).arg(script).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let mut input = child.stdin.take().unwrap();
    let text = question.to_string();
    let writer = std::thread::spawn(move || input.write_all(text.as_bytes()).unwrap());
    let output = child.wait_with_output().unwrap();
    writer.join().unwrap();
    assert!(output.status.success(), "the script failed");
    serde_json::from_slice(&output.stdout).unwrap()
}

/// What Pinocchio and coal say of paths (`tests/python/recheck_paths.py`): problems, and the rows that the benchmark
/// would write of them. `package`: name and folder of `package://` in the URDF.
#[track_caller]
pub fn recheck(
    python: &Path,
    urdf: &Path,
    package: Option<(&str, &Path)>,
    problems: &[serde_json::Value],
    rows: &[serde_json::Value],
) -> String {
    let folder = tempfile::tempdir().unwrap();
    let [listed, answered] = ["problems.jsonl", "rows.json"].map(|file| folder.path().join(file));
    let lines: Vec<String> = problems.iter().map(ToString::to_string).collect();
    std::fs::write(&listed, lines.join("\n")).unwrap();
    std::fs::write(&answered, serde_json::json!({ "rows": rows }).to_string()).unwrap();
    let mut command = Command::new(python);
    command.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/recheck_paths.py"));
    command.arg("--rows").arg(&answered).arg("--problems").arg(&listed).arg("--urdf").arg(urdf);
    if let Some((name, at)) = package {
        command.arg("--package").arg(format!("{name}={}", at.display()));
    }
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}
