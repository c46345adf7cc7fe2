//! `assets/python/dimos_client.py` against the real binary: read, stream, move, servo from a policy loop, grip, stop.

use std::path::Path;
use std::process::{Command, Stdio};

use crate::support::program::{Ended, Home, Started};
use crate::support::skip::skip;

const BLUEPRINT: &str = "
hardware:
  - {hardware_id: arm, joints: {prefix: arm, count: 6}, adapter_type: mock}
tasks:
  - {name: traj_arm, type: trajectory, joint_names: {hardware: arm}}
  - {name: servo_arm, type: servo, joint_names: {hardware: arm}, priority: 20}
  - {name: velocity_arm, type: velocity, joint_names: {hardware: arm}, priority: 30}
  - {name: twist_arm, type: eef_twist, joint_names: {hardware: arm}, priority: 40, params:
      {model_path: 'builtin:yourarm', end_effector_link: flange, joint_prefix: arm_}}
  - {name: pose_arm, type: cartesian_ik, joint_names: {hardware: arm}, priority: 50, params:
      {model_path: 'builtin:yourarm', end_effector_link: flange, joint_prefix: arm_}}
";

/// `python3 ARGUMENTS`, with the client to import; `None` where there is no Python.
fn python(home: &Home, arguments: &[&str]) -> Option<Ended> {
    if Command::new("python3").arg("--version").stdout(Stdio::null()).status().is_err() {
        skip("python3");
        return None;
    }
    let mut command = Command::new("python3");
    let assets = Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/python");
    command.args(arguments).env("PYTHONPATH", assets).env("PYTHONPYCACHEPREFIX", home.path());
    Some(Started::of(home.settle(&mut command).stdin(Stdio::null())).wait())
}

fn file(name: &str) -> String {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(name).display().to_string()
}

#[test]
fn the_client_does_all_that_it_says() {
    let home = Home::new();
    home.write("scripts.yaml", BLUEPRINT);
    let run = home.run("scripts.yaml --no-record");
    let Some(ended) = python(&home, &[&file("tests/python/try_client.py")]) else { return };
    assert!(ended.with(0).out.ends_with("all is as it says\n"));
    run.wait().with(0).says(&["shutdown requested"]);
}

#[test]
fn the_client_waits_for_no_run_without_limit() {
    let home = Home::new();
    let Some(ended) = python(&home, &[&file("tests/python/hung_run.py")]) else { return };
    assert!(ended.with(0).out.ends_with("all waits have ended\n"));
}

#[test]
fn the_example_follows_its_policy() {
    let home = Home::new();
    home.write("scripts.yaml", BLUEPRINT);
    let example = file("assets/python/example_policy.py");
    let Some(alone) = python(&home, &[&example, "servo_arm"]) else { return };
    alone.with(1).says(&["error: no run is live [NO_RUN]\nhint: start one: dimos run"]);
    let _run = home.run("scripts.yaml --no-record");
    let Some(ended) = python(&home, &[&example, "servo_arm", "--seconds", "1"]) else { return };
    assert!(ended.with(0).out.contains(" targets in 1."), "it says how it kept its time");
}

const PAGE: &str = include_str!("../../docs/python.md");

/// The blocks of a language on the page.
fn blocks(language: &str) -> Vec<&'static str> {
    let begin = format!("\n```{language}\n");
    PAGE.split(begin.as_str()).skip(1).map(|rest| rest.split("\n```").next().unwrap()).collect()
}

#[test]
fn every_example_of_the_page_runs() {
    let home = Home::new();
    let [blueprint] = blocks("yaml")[..] else { panic!("one blueprint") };
    home.write("streams.yaml", blueprint);
    let _run = home.run("streams.yaml --no-record");
    let examples = blocks("python");
    assert!(examples.len() >= 6, "{}", examples.len());
    for example in examples {
        let Some(ended) = python(&home, &["-c", example]) else { return };
        assert!(!ended.with(0).err.contains("Traceback"), "{example}");
    }
}

/// A method that is added is added to the page too.
#[test]
fn the_page_names_every_public_method_and_class() {
    let client = std::fs::read_to_string(file("assets/python/dimos_client.py")).unwrap();
    let mut named = 0;
    for line in client.lines() {
        let line = line.trim_start();
        let Some(rest) = line.strip_prefix("def ").or_else(|| line.strip_prefix("class ")) else { continue };
        let name = rest.split(['(', ':']).next().unwrap();
        if !name.starts_with('_') {
            named += 1;
            let shown = [format!("`{name}"), format!("{name}("), format!(".{name}")];
            assert!(shown.iter().any(|form| PAGE.contains(form.as_str())), "{name} is not on docs/python.md");
        }
    }
    assert!(named > 25, "{named}");
}

#[test]
fn the_files_are_python_3_9_of_bounded_length() {
    let home = Home::new();
    let check = "import ast, sys; [ast.parse(open(f).read(), feature_version=(3, 9)) for f in sys.argv[1:]]";
    let files = [file("assets/python/dimos_client.py"), file("assets/python/example_policy.py")];
    let Some(ended) = python(&home, &["-c", check, &files[0], &files[1]]) else { return };
    ended.with(0);
    let Some(ended) = python(&home, &["-m", "py_compile", &files[0], &files[1]]) else { return };
    ended.with(0);
    assert!(std::fs::read_to_string(&files[0]).unwrap().lines().count() <= 385, "one file that can be read");
}
