//! `assets/python/dimos_client` against the real binary: read, stream, move, plan, follow a policy, grip, stop.

use std::path::Path;
use std::process::{Command, Stdio};

use dimos::arms::yourarm::emulator::{SimOptions, YourArmEmulator};
use dimos::hardware::registry::Emulator;

use crate::support::program::{Ended, Home, Started};
use crate::support::python::python_with;
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
    command.env("DIMOS", env!("CARGO_BIN_EXE_dimos"));
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
    alone.with(1).says(&["error: no run of this user is live [NO_RUN]\nhint: start one: dimos run"]);
    let _run = home.run("scripts.yaml --no-record");
    let Some(ended) = python(&home, &[&example, "servo_arm", "--seconds", "1"]) else { return };
    assert!(ended.with(0).out.contains(" targets in 1."), "it says how it kept its time");
}

/// Runs a script beside a run of the page's blueprint.
fn tries(script: &str) {
    let home = Home::new();
    let [blueprint] = blocks("yaml")[..] else { panic!("one blueprint") };
    home.write("streams.yaml", blueprint);
    let _run = home.run("streams.yaml --no-record");
    let Some(ended) = python(&home, &[&file(script)]) else { return };
    assert!(ended.with(0).out.ends_with("all is as it says\n"));
}

#[test]
fn with_a_planner_the_client_plans() {
    tries("tests/python/try_planner.py");
}

#[test]
fn with_a_planner_the_client_passes_waypoints() {
    tries("tests/python/try_waypoints.py");
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
    let recipes = PAGE.lines().filter(|line| line.starts_with("### ") && line.as_bytes()[4].is_ascii_digit()).count();
    assert!(examples.len() >= 10 && examples.len() == recipes, "{} of {recipes}", examples.len());
    for example in examples {
        let Some(ended) = python(&home, &["-c", example]) else { return };
        assert!(!ended.with(0).err.contains("Traceback"), "{example}");
    }
}

/// A name that is added is added to the page too.
#[test]
fn the_page_names_everything_public() {
    let home = Home::new();
    let list = "import dimos_client as d; print(*d.__all__, *(n for n in dir(d.Client) if n[0] != '_'))";
    let Some(ended) = python(&home, &["-c", list]) else { return };
    let names = ended.with(0).out.clone();
    assert!(names.split_whitespace().count() > 40, "{names}");
    for name in names.split_whitespace() {
        let shown = [format!("`{name}"), format!("{name}("), format!(".{name}")];
        assert!(shown.iter().any(|form| PAGE.contains(form.as_str())), "{name} is not on docs/python.md");
    }
}

/// The files of the package.
fn package() -> Vec<String> {
    let files = std::fs::read_dir(file("assets/python/dimos_client")).unwrap().map(|entry| entry.unwrap().path());
    let sources = files.filter(|path| path.extension().is_some_and(|ending| ending == "py"));
    let mut sources: Vec<String> = sources.map(|path| path.display().to_string()).collect();
    sources.sort();
    assert!(sources.len() > 4, "{sources:?}");
    sources
}

#[test]
fn the_files_are_python_3_9_of_bounded_length() {
    let home = Home::new();
    let mut arguments = vec![
        "-c".to_owned(),
        "import ast, sys; [ast.parse(open(f).read(), feature_version=(3, 9)) for f in sys.argv[1:]]".to_owned(),
    ];
    arguments.extend(package());
    arguments.push(file("assets/python/example_policy.py"));
    let Some(ended) = python(&home, &arguments.iter().map(String::as_str).collect::<Vec<_>>()) else { return };
    ended.with(0);
    for source in package() {
        let text = std::fs::read_to_string(&source).unwrap();
        assert!(text.lines().count() <= 350, "{source}");
    }
}

/// A user's type checker knows the client, and finds no mistake in it.
#[test]
fn mypy_accepts_the_client() {
    let Some(python) = python_with(&["mypy"]) else { return };
    let home = Home::new();
    let mut command = Command::new(python);
    command.args(["-m", "mypy", "--strict", "--python-version", "3.9", "--cache-dir", "mypy", "-p", "dimos_client"]);
    command.env("MYPYPATH", file("assets/python"));
    Started::of(home.settle(&mut command).stdin(Stdio::null())).wait().with(0).shows(&["no issues found"]);
}

#[test]
fn pip_installs_the_client_with_its_types() {
    let Some(python) = python_with(&["pip", "flit_core"]) else { return };
    let (home, package) = (Home::new(), file("assets/python"));
    let mut install = Command::new(&python);
    install.args(["-m", "pip", "install", "--no-index", "--no-build-isolation", "--no-deps", "--target", "site"]);
    Started::of(home.settle(install.arg(&package)).stdin(Stdio::null())).wait().with(0);
    let site = home.path().join("site");
    assert!(site.join("dimos_client/py.typed").exists());
    let version = format!("dimos_client-{}.dist-info", env!("CARGO_PKG_VERSION"));
    assert!(site.join(&version).exists(), "{version}");
    let mut used = Command::new(&python);
    used.args(["-c", "import dimos_client; print(dimos_client.__file__)"]).env("PYTHONPATH", &site);
    let ended = Started::of(home.settle(&mut used).stdin(Stdio::null())).wait();
    assert!(ended.with(0).out.starts_with(&site.display().to_string()));
}

/// An object between the fingers, put there by the test.
#[test]
fn the_gripper_tells_whether_it_holds_something() {
    let (home, arm) = (Home::new(), YourArmEmulator::with(&SimOptions::default()).unwrap());
    let _run = home.run(&format!("coordinator-yourarm --no-record --set hardware.arm.address={}", arm.address()));
    let grip = |command: &str| {
        let script = format!(
            "from dimos_client import Client\nwith Client.connect() as robot:\n    grip = robot.gripper({command})\n    \
             print(grip.outcome, grip.holding, round(grip.position, 4), grip.force)"
        );
        python(&home, &["-c", &script]).map(|ended| ended.with(0).out.clone())
    };
    let Some(opened) = grip("'arm', 'open'") else { return };
    assert_eq!(opened, "open False 0.08 0.0\n");
    arm.put_object(0.03);
    assert_eq!(grip("'arm', 'close', force=12.5").unwrap(), "holding True 0.03 12.5\n");
    assert_eq!(grip("'arm', 0.01").unwrap().split(' ').next(), Some("holding"), "again");
    assert_eq!(grip("'arm', 0.05").unwrap().split(' ').next(), Some("reached"));
}
