//! `dimos adapter new`: what it writes is built, tested and run as a user would; what is in the way stays as it is.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use rustix::process::Signal;
use serde_json::Value;

use crate::support::crates::{CHECKOUT, programs, share_builds, without_cargo_settings};
use crate::support::program::{Home, Started, UP};

/// All files below a folder with their texts, by path.
fn files(folder: &Path) -> Vec<(PathBuf, String)> {
    let mut all = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            all.extend(files(&path));
        } else {
            all.push((path.clone(), fs::read_to_string(&path).unwrap()));
        }
    }
    all.sort();
    all
}

/// Builds and tests the packages in a folder; fails on any warning. Returns the folder of its programs.
fn cargo_test(folder: &Path, packages: &[&str]) -> PathBuf {
    share_builds(folder);
    for verb in ["test", "build"] {
        let mut command = Command::new(std::env::var_os("CARGO").unwrap_or("cargo".into()));
        command.args([verb, "--quiet"]).args(packages.iter().flat_map(|name| ["-p", name]));
        let output = without_cargo_settings(command.current_dir(folder).stdin(Stdio::null())).output().unwrap();
        let text = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
        println!("{text}");
        assert!(output.status.success(), "cargo {verb} in {}", folder.display());
        // Only warnings in the crate's own files have relative paths.
        let own = |line: &str| ["--> src/", "--> tests/"].iter().any(|start| line.trim_start().starts_with(start));
        assert!(!text.lines().any(own), "it does not compile without warnings");
    }
    programs()
}

#[test]
fn a_new_crate_builds_passes_its_tests_and_runs() {
    let home = Home::new();
    let made = home.dimos("adapter new acme-arm --dof 7 --transport tcp").with(0);
    let next: Vec<&str> = made.out.lines().skip_while(|line| *line != "next:").skip(1).collect();
    assert_eq!(next.len(), 5, "{}", made.out);
    assert!(next[3].contains("the URDF has no gripper") && next[4].contains("Cargo.lock"), "{}", made.out);
    assert!(next[0].contains("cd acme-arm && cargo test"), "{}", made.out);
    let folder = home.path().join("acme-arm");
    let programs = cargo_test(&folder, &["acme-arm", "acme-arm-program"]);

    let acme = |arguments: &str, at: &Path| {
        let mut command = Command::new(programs.join("acme-arm"));
        home.settle(command.args(arguments.split_whitespace())).current_dir(at).stdin(Stdio::null());
        Started::of(&mut command).wait().with(0)
    };
    let rows = acme("list-adapters --json", &folder).json();
    let mut rows = rows.as_array().unwrap().iter();
    let row = rows.clone().find(|row| row["name"] == "acme_arm").expect("its row");
    assert_eq!((&row["dof"]["max"], &row["transport"]), (&7.into(), &"tcp".into()));
    assert!(rows.any(|row| row["name"] == "yourarm"), "the built-in arms are there too");

    acme("run coordinator-acme-arm --sim --duration 1s --no-record", &folder);
    // Elsewhere the program has its blueprint all the same.
    acme("check coordinator-acme-arm", home.path());
    let listed = acme("list-blueprints", home.path()).out;
    assert!(listed.contains("coordinator-acme-arm") && listed.contains("coordinator-yourarm"), "{listed}");
    plans_and_moves(&home, &programs.join("acme-arm"));
}

/// What `cargo test` of a new arm compiles: packages of others, and lines of dimos.
#[test]
fn a_new_arm_compiles_a_small_part_of_dimos() {
    for transport in ["tcp", "can", "serial"] {
        let home = Home::new();
        home.dimos(&format!("adapter new acme --dof 6 --transport {transport}")).with(0);
        let folder = home.path().join("acme");
        fs::copy(Path::new(CHECKOUT).join("Cargo.lock"), folder.join("Cargo.lock")).unwrap();
        let mut command = Command::new(std::env::var_os("CARGO").unwrap_or("cargo".into()));
        command.args(["tree", "--offline", "--prefix", "none", "--edges", "normal,build"]).current_dir(&folder);
        let output = without_cargo_settings(&mut command).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let tree = String::from_utf8(output.stdout).unwrap();
        let packages: BTreeSet<&str> = tree.lines().map(|line| line.trim_end_matches(" (*)")).collect();
        let ours = packages.iter().filter_map(|line| line.split_once(&format!("({CHECKOUT}"))?.1.strip_suffix(')'));
        let lines: usize = ours
            .flat_map(|path| files(&Path::new(&format!("{CHECKOUT}{path}")).join("src")))
            .map(|(_, text)| text.lines().count())
            .sum();
        println!("{transport}: {} packages, {lines} lines of dimos", packages.len());
        assert!(packages.len() <= 80 && lines > 10_000 && lines <= 40_000, "{transport}: {packages:#?}, {lines} lines");
    }
}

/// The new arm's description and its planner, from anywhere, before anything in them has been changed.
fn plans_and_moves(home: &Home, program: &Path) {
    let start = |arguments: &str| {
        let mut command = Command::new(program);
        Started::of(home.settle(command.args(arguments.split_whitespace())).stdin(Stdio::null()))
    };
    let acme = |arguments: &str| start(arguments).wait().with(0);
    let checked = acme("model check builtin:acme_arm");
    assert!(!format!("{}{}", checked.out, checked.err).contains("warning"), "{}{}", checked.out, checked.err);
    let tip = acme("model fk builtin:acme_arm 0 0 0 0 0 0 0 --link flange --json").json();
    assert!((tip["xyz"][2].as_f64().unwrap() - 1.1).abs() < 1e-9, "it points straight up: {tip}");
    let checked = acme("check acme-arm-planner");
    assert!(!format!("{}{}", checked.out, checked.err).contains("warning"), "{}{}", checked.out, checked.err);

    let run = start("run acme-arm-planner --sim --no-record");
    run.until(UP);
    let planned = acme("plan arm --named home").out;
    assert!(planned.contains("clearance"), "{planned}");
    acme("preview");
    acme("execute");
    is_at(home, &[0.0, 0.53, 0.0, 0.53, 0.0, 0.53, 0.0]);
    acme("move arm --named zero --speed 1");
    is_at(home, &[0.0; 7]);
    acme("move arm --pose 0.4 0.2 0.4 --speed 1");
    let refused = start("plan arm --pose 0.3 0 -0.2").wait().with(1);
    assert!(refused.err.contains("hint: "), "{}", refused.err);
    run.end(Signal::INT).with(130);
}

fn is_at(home: &Home, goal: &[f64]) {
    let is = home.positions("arm");
    assert!(is.len() == goal.len() && is.iter().zip(goal).all(|(is, goal)| (is - goal).abs() < 0.01), "{is:?}");
}

/// The conformance suite over the table of that checkout.
const SUITE: &str = r#"
use real::hardware::conformance::{Outcome, Subject, checks, run_all};

#[test]
fn the_table_conforms() {
    let table = skeleton::TABLE;
    assert_eq!(table.len(), 3);
    for row in table {
        for (check, outcome, _) in run_all(&Subject::emulated(row), &checks().collect::<Vec<_>>(), &|_, _| (), &|| false) {
            assert!(!matches!(outcome, Outcome::Failed(_)), "{} {}: {outcome:?}", row.name, check.name);
        }
    }
}
"#;

/// A checkout of dimos as far as a new arm sees it: the table of arms, on the crates of the real one. So new arms are
/// compiled and tested without building the tree again.
fn checkout(folder: &Path) {
    let real = fs::canonicalize(CHECKOUT).unwrap();
    for (path, text) in [
        (
            "Cargo.toml",
            format!(
                "[package]\nname = \"dimos\"\nversion = \"0.0.0\"\nedition = \"2024\"\n\n\
                 [lib]\nname = \"skeleton\"\npath = \"crates/arms/src/lib.rs\"\n\n\
                 [dependencies]\nreal = {{ package = \"dimos\", path = {real:?} }}\ndimos-core = {{ path = \"{}/crates/core\" }}\n\
                 dimos-hardware = {{ path = \"{}/crates/hardware\" }}\nschemars = \"1\"\n\
                 serde = {{ version = \"1\", features = [\"derive\"] }}\n",
                real.display(),
                real.display()
            ),
        ),
        (
            "crates/arms/src/lib.rs",
            "use dimos_hardware::registry::AdapterSpec;\n\npub const TABLE: &[AdapterSpec] = &[\n];\n".into(),
        ),
        ("crates/robot/src/builtin.rs", "robots!(\n);\n".into()),
        ("crates/robot/robots/lite6.urdf", String::new()),
        ("tests/conformance.rs", SUITE.into()),
    ] {
        let path = folder.join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }
}

/// Adds a line that the program printed: at the end of its list, or of the file. Returns the file's name.
fn add(folder: &Path, line: &Value) -> String {
    let [file, list, line] = ["file", "list", "line"].map(|key| line[key].as_str().unwrap().to_owned());
    let text = fs::read_to_string(folder.join(&file)).unwrap();
    let end = match list.as_str() {
        "" => text.len(),
        list => {
            text.find(list).and_then(|at| Some(at + text[at..].find("\n]").or(text[at..].find("\n)"))? + 1)).unwrap()
        }
    };
    let (before, after) = text.split_at(end);
    let indent = if list.is_empty() { "" } else { "    " };
    fs::write(folder.join(&file), format!("{before}{indent}{line}\n{after}")).unwrap();
    file
}

#[test]
fn arms_in_the_tree_build_and_conform() {
    let home = Home::new();
    let tree = home.path().join("tree");
    checkout(&tree);
    for (name, transport, dof) in [("otto", "serial", 16), ("acme", "tcp", 1), ("penny-2", "can", 5)] {
        let line = format!("adapter new {name} --dof {dof} --transport {transport} --in-tree --path tree --json");
        let report = home.dimos(&line).with(0).json();
        let added: Vec<_> = report["add"].as_array().unwrap().iter().map(|line| add(home.path(), line)).collect();
        assert_eq!(
            added,
            ["tree/crates/arms/src/lib.rs", "tree/crates/arms/src/lib.rs", "tree/crates/robot/src/builtin.rs"]
        );
        let files = match transport {
            "can" => 8,
            "tcp" => 9,
            _ => 10,
        };
        assert_eq!(report["written"].as_array().unwrap().len(), files, "{report}");
        let blueprint = fs::read_to_string(tree.join(format!("blueprints/coordinator-{name}.yaml"))).unwrap();
        assert!(blueprint.contains(&format!("count: {dof}}}")), "{blueprint}");
        let snake = name.replace('-', "_");
        assert!(blueprint.contains(&format!("adapter_type: {snake}\n")), "{blueprint}");
        home.dimos(&format!("model check tree/crates/robot/robots/{snake}.urdf")).with(0);
        let planner = fs::read_to_string(tree.join(format!("blueprints/{name}-planner.yaml"))).unwrap();
        assert!(planner.contains(&format!("model_path: builtin:{snake} #")), "{planner}");
    }
    let robots = fs::read_to_string(tree.join("crates/robot/src/builtin.rs")).unwrap();
    assert_eq!(robots, "robots!(\n    \"otto\",\n    \"acme\",\n    \"penny_2\",\n);\n");
    // In one workspace with the real one it needs a name of its own.
    let manifest = fs::read_to_string(tree.join("Cargo.toml")).unwrap();
    fs::write(tree.join("Cargo.toml"), manifest.replacen("name = \"dimos\"", "name = \"tree\"", 1)).unwrap();
    cargo_test(&tree, &["tree"]);
}

#[test]
fn no_file_is_overwritten_or_left_half_written() {
    let home = Home::new();
    let tree = home.path().join("tree");
    checkout(&tree);
    fs::create_dir_all(home.path().join("taken")).unwrap();
    fs::create_dir_all(tree.join("blueprints")).unwrap();
    fs::write(tree.join("blueprints/coordinator-planned.yaml"), "mine").unwrap();
    fs::create_dir_all(tree.join("crates/arms/src/there")).unwrap();
    let before = files(home.path());
    for (arguments, part) in [
        ("taken --dof 6 --transport tcp", "taken is there already: nothing was written"),
        ("acme --dof 6 --transport tcp --path nowhere", "there is no folder nowhere"),
        ("acme --dof 6 --transport tcp --dimos taken", "taken is no checkout of dimos"),
        ("acme --dof 6 --transport tcp --in-tree --path taken", "taken is no checkout of dimos"),
        ("planned --dof 6 --transport tcp --in-tree --path tree", "coordinator-planned.yaml is there already"),
        ("there --dof 6 --transport can --in-tree --path tree", "arms/src/there is there already"),
        ("lite6 --dof 6 --transport tcp --in-tree --path tree", "lite6.urdf is there already"),
        ("yourarm --dof 6 --transport serial", "there is an adapter yourarm already"),
        ("loop --dof 6 --transport serial", "it is a word of Rust"),
        ("../acme --dof 6 --transport serial", "begin it with a lower-case letter"),
        ("acme --dof 0 --transport tcp", "--dof"),
        ("acme --dof 17 --transport tcp", "--dof"),
        ("acme --dof 6 --transport usb", "--transport"),
        ("acme --dof 6", "--transport"),
    ] {
        let refused = home.dimos(&format!("adapter new {arguments}"));
        assert_eq!((refused.code, refused.out.as_str()), (Some(2), ""), "{arguments}: {}", refused.err);
        assert!(refused.err.contains(part), "{arguments}: {}", refused.err);
    }
    assert_eq!(files(home.path()), before);
}
